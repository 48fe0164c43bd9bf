// The page of gripmon watch --web.  All texts of monitors go into text nodes: they come from the network.

import { showMount } from "./mount.js";
import { $, element, get, post, setText } from "./page.js";

const PERIOD_MS = 1000, PICTURE_MS = 10_000, MOUNT_MS = 500, OLD_S = 25;
const cards = new Map();   // by name and id: {root, card, picture, asked, seen, next}
let hover = false, ended = false, last = 0;

const clock = (ns) => new Date(ns / 1e6).toLocaleTimeString();
const mm = (metres, digits) => (metres === null ? "–" : (1e3 * metres).toFixed(digits));
const keyOf = (card) => JSON.stringify([card.robot, card.camera, card.monitor_id]);
const named = (card) => `${card.robot}/${card.camera}`;

const visible = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) target.dataset.visible = isIntersecting;
}, { rootMargin: "200px" });

function made(card) {
  const root = $("#card").content.firstElementChild.cloneNode(true);
  const entry = { root, card, asked: null, next: 0, stamp: 0, url: "", loading: false };
  root.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button || button.disabled) return;
    if (button.classList.contains("by-hand")) byHand(entry);
    else if (button.dataset.order) ask(entry, button.dataset.order, button.dataset.argument ?? "");
    else if (button.classList.contains("yes")) carryOut(entry);
    else if (button.classList.contains("no")) { entry.asked = null; show(entry); }
  });
  visible.observe(root);
  return entry;
}

// While somebody moves the camera, a picture comes twice a second.
function byHand(entry) {
  entry.mount = !entry.mount;
  $(".by-hand", entry.root).setAttribute("aria-pressed", entry.mount);
  $(".mount", entry.root).hidden = true;
  entry.next = 0;
  loadPicture(entry);
}

function ask(entry, name, argument) {
  const { card } = entry, who = named(card);
  const order = { robot: card.robot, camera: card.camera, monitor_id: card.monitor_id, name, argument, revision: card.revision };
  if (["accept", "reject"].includes(name)) order.argument = card.proposal_id;
  const questions = {
    accept: `Accept ${card.proposal_id} as reference of ${who}? Drift is measured from it.`,
    reject: `Discard the proposal ${card.proposal_id} of ${who}?`,
    undo: `Go back from ${card.reference_id} (revision ${card.revision}) to the reference before it, on ${who}?`,
  };
  entry.asked = order;
  $(".answer", entry.root).hidden = true;
  if (questions[name]) { setText($(".asked p", entry.root), questions[name]); show(entry); $(".asked .no", entry.root).focus(); }
  else carryOut(entry);
}

async function carryOut(entry) {
  const order = entry.asked, line = $(".answer", entry.root);
  entry.asked = null;
  entry.busy = true;
  show(entry);
  let kind = "bad", text = "";
  try {
    const answer = await post("order", order);
    kind = answer.done ? "good" : "warn";
    text = `${answer.done ? "done" : "refused"}: ${answer.text}`;
  } catch (error) { text = `${order.name}: ${error.message}`; }
  entry.busy = false;
  line.dataset.kind = kind;
  line.hidden = false;
  setText(line, `${new Date().toLocaleTimeString()} ${text}`);
  entry.next = 0;
  show(entry);
}

function numbers(card) {
  const bound = card.protection_m === null ? "–" : `at most ${mm(card.protection_m, 2)} mm, allowed ${mm(card.alert_limit_m, 2)}`;
  return [
    ["drift", card.drift_m === null ? "–" : `${mm(card.drift_m, 3)} mm (1 sigma ${mm(card.sigma_m, 3)})`],
    ["error", bound],
    ["frames", card.frames_per_s === null ? "–" : `${card.frames_per_s.toFixed(1)} a second`],
    ["reference", card.revision < 0 ? "–" : `${card.revision} ${card.reference_id}`],
    ["heard", `${card.heard_s.toFixed(0)} s ago`],
  ];
}

// Only texts are replaced, never a button that someone is about to press.
function showAlerts(list, alerts, more) {
  const items = new Map([...list.children].map((item) => [item.dataset.id, item]));
  const wanted = alerts.map((alert) => {
    const item = items.get(alert.alert_id) ?? alertItem(alert);
    const since = alert.since_ns === null ? "" : `, since ${clock(alert.since_ns)}`;
    item.dataset.severity = alert.severity;
    setText($("b", item), alert.kind);
    setText($("i", item), alert.text);
    setText($("small", item), `${since}${alert.acknowledged ? ", acknowledged" : ""}`);
    $("button", item).hidden = alert.acknowledged;
    return item;
  });
  if (more) {
    const rest = items.get("more") ?? element("li", "");
    rest.dataset.id = "more";
    setText(rest, `${more} more: gripmon send state`);
    wanted.push(rest);
  }
  if (wanted.length !== list.children.length || wanted.some((item, k) => list.children[k] !== item)) list.replaceChildren(...wanted);
}

function alertItem(alert) {
  const item = element("li", ""), words = element("span", ""), button = element("button", "Acknowledge");
  item.dataset.id = alert.alert_id;
  words.append(element("b", ""), " ", element("i", ""), element("small", ""));
  button.dataset.order = "acknowledge";
  button.dataset.argument = alert.alert_id;
  item.append(words, button);
  return item;
}

function show(entry) {
  const { root, card } = entry, gone = ["gone", "stopped"].includes(card.condition);
  root.dataset.condition = card.condition;
  setText($("h2", root), named(card));
  setText($(".condition", root), card.condition);
  const since = card.gone_since_ns === null ? "" : `${card.condition} since ${clock(card.gone_since_ns)}; last known values below`;
  const silent = card.condition === "silent" ? `no message for ${card.heard_s.toFixed(0)} s: it hangs; last known values below` : "";
  const several = card.condition === "several" ? `one of several monitors of this name (${card.monitor_id}): use neither, stop one` : "";
  setText($(".said", root), [since || silent || several, card.state && (gone ? `was ${card.state}` : card.state), card.message].filter(Boolean).join("; "));
  const list = $("dl", root), values = numbers(card);
  if (!list.children.length) for (const [name] of values) list.append(element("dt", name), element("dd", ""));
  values.forEach(([, value], k) => setText(list.children[2 * k + 1], value));
  showAlerts($(".alerts", root), card.alerts, card.more_alerts);
  const proposal = $(".proposal", root);
  proposal.hidden = !card.proposal_id;
  setText($("p", proposal), `A new reference waits: ${card.proposal_id}`);
  if (gone || ended) $(".mount", root).hidden = true;   // what it showed may no longer hold
  $(".asked", root).hidden = !entry.asked;
  $('[data-order="undo"]', root).hidden = card.revision < 1;
  const dead = gone || ended || entry.busy;
  for (const button of root.querySelectorAll("button")) button.disabled = dead || (entry.asked !== null && Boolean(button.dataset.order));
  caption(entry, gone);
}

function caption(entry, gone) {
  const line = $("figcaption", entry.root), age_s = (Date.now() - entry.stamp / 1e6) / 1e3;
  const old = gone || ended || age_s > OLD_S;
  entry.root.classList.toggle("old", old && entry.stamp > 0);
  const shown = entry.stamp ? `${old ? "not live: of " : ""}${clock(entry.stamp)}, ${entry.verdict}` : "";
  const why = entry.why ? `no ${entry.stamp ? "newer " : ""}picture: ${entry.why}` : "";
  setText(line, [shown, why].filter(Boolean).join("; ") || (gone ? "no picture" : "picture …"));
}

async function loadPicture(entry) {
  if (entry.loading) return;
  const { card, mount } = entry, query = new URLSearchParams({ robot: card.robot, camera: card.camera, id: card.monitor_id });
  if (mount) query.set("mount", 1);
  entry.loading = true;
  entry.next = Date.now() + PICTURE_MS;
  try {
    const found = await get(`picture?${query}`);
    const bytes = Uint8Array.from(atob(found.jpeg), (c) => c.charCodeAt(0)), image = $("img", entry.root);
    const url = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
    image.src = url;
    image.alt = `what ${named(card)} sees`;
    image.hidden = false;
    if (entry.url) URL.revokeObjectURL(entry.url);
    Object.assign(entry, { url, stamp: found.stamp_ns, verdict: found.verdict, why: "" });
    if (mount && entry.mount) {
      $(".mount", entry.root).hidden = !found.mount;
      if (found.mount) showMount($(".mount", entry.root), found.mount);
      else entry.why = "this monitor doesn't say how its camera is mounted";
    }
  } catch (error) {
    entry.why = error.message;
    $(".mount", entry.root).hidden = true;   // what it showed may no longer hold
  }
  entry.loading = false;
  show(entry);
  if (entry.mount && entry.root.isConnected && !ended) setTimeout(() => { if (entry.mount) loadPicture(entry); }, MOUNT_MS);
}

function arrange(shown) {
  const keys = new Set(shown.cards.map(keyOf));
  for (const [key, entry] of cards) {
    if (keys.has(key)) continue;
    visible.unobserve(entry.root);
    if (entry.url) URL.revokeObjectURL(entry.url);
    entry.root.remove();
    cards.delete(key);
  }
  const main = $("#cards"), nodes = shown.cards.map((card) => {
    const key = keyOf(card);
    if (!cards.has(key)) cards.set(key, made(card));
    const entry = cards.get(key);
    entry.card = card;
    show(entry);
    return entry.root;
  });
  // Cards never move while someone is about to press a button.
  const held = (hover || main.contains(document.activeElement)) && nodes.every((node) => node.parentNode === main);
  if (!held && nodes.some((node, k) => main.children[k] !== node)) main.replaceChildren(...nodes);
}

function say(text, kind) {
  const line = $("#status");
  line.hidden = !text;
  line.dataset.kind = kind;
  setText(line, text);
}

async function look() {
  try {
    const shown = await get(`fleet?${new URLSearchParams({ find: $("#find").value.trim() })}`);
    ended = false;
    last = shown.stamp_ns;
    const total = Object.values(shown.counts).reduce((a, b) => a + b, 0);
    const parts = Object.entries(shown.counts).map(([name, count]) => `${count} ${name}`).join(", ");
    setText($("#counts"), total ? `${total} monitor${total === 1 ? "" : "s"}: ${parts}` : "no monitor yet");
    const none = total || shown.fault ? "" : "No monitor is on the network: is --connect right?";
    say(shown.fault || none, shown.fault ? "bad" : "warn");
    arrange(shown);
    $("#hidden").hidden = !shown.hidden;
    setText($("#hidden"), `${shown.hidden} more, none in a worse state; find them by name`);
    for (const entry of cards.values()) {
      const there = !["gone", "stopped"].includes(entry.card.condition);
      if (there && !entry.loading && entry.root.dataset.visible === "true" && Date.now() >= entry.next) loadPicture(entry);
    }
  } catch (error) {
    ended = true;
    say(`${error.message}${last ? `; shown: state of ${clock(last)}` : ""}`, "bad");
    for (const entry of cards.values()) show(entry);
  }
  document.body.dataset.ended = ended;
  document.body.dataset.ready = "true";
}

async function watch() {
  await look();
  setTimeout(watch, PERIOD_MS);
}

$("#cards").addEventListener("pointerenter", () => { hover = true; });
$("#cards").addEventListener("pointerleave", () => { hover = false; });
$("#find").addEventListener("input", look);
$("#done").addEventListener("click", async () => { await post("done", {}).catch(() => {}); look(); });
watch();
