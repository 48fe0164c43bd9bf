// One step at a time: its form and buttons, what the camera or the monitor shows, and the result.

import { showMount } from "./mount.js";
import { $, element, get, over, post, setText, shape } from "./page.js";

const QUIET_MS = 1000, LIVELY_MS = 250;
const MARKS = { done: "✓", stale: "!", skipped: "–" };
const NAMED = { ready: "", done: "", stale: "do this again", waits: "", skipped: "not needed" };
const READ = { ...NAMED, ready: "not done yet", done: "done" };
const drawn = new Map(), lost = new Map();

let state, chosen = null, refused = "", typed = {}, frame = { live: 0, monitor: 0 }, ended = false, timer = null;

// Nodes that are drawn again lose the focus, and a click that has begun: only what differs is, and the focus returns, once
// it can: a button that is at work can't have it.
function redraw(parent, shown, make) {
  const key = JSON.stringify(shown), named = (node) => node.dataset.step ?? (node.id || node.name);
  if (drawn.get(parent) === key) return;
  drawn.set(parent, key);
  const active = document.activeElement, held = parent.contains(active) ? named(active) : active === document.body && lost.get(parent);
  parent.replaceChildren(...make());
  lost.delete(parent);
  if (!held) return;
  const nodes = [...parent.querySelectorAll("button, input, select")];
  (nodes.find((node) => named(node) === held) ?? nodes.find((node) => !node.disabled))?.focus();
  if (!parent.contains(document.activeElement)) lost.set(parent, held);
}

const step = () => state.steps.find((each) => each.state.name === chosen);
const capture = () => (state.capturing === chosen ? state.capture : null);
const taking = () => Boolean(capture()?.running && !capture().ended);
// What is entered and not yet used: the server keeps it without blanks.
const entered = () => step().fields.some(({ name }) => name in typed && typed[name].trim() !== state.values[name]);
// Of all steps: what is asked may depend on another one's.
const everything = () => ({ ...state.values, ...typed });
// The values of this step, and those typed before and not yet sent: they count, too.
const said = () => ({ ...typed, ...Object.fromEntries(step().fields.map(({ name }) => [name, everything()[name]])) });

function choose(name) {
  chosen = name;
  refused = "";
  history.replaceState(null, "", `#${name}`);
  show();
  $("#title").scrollIntoView({ block: "nearest" });
}

// To another step by its button in this one, which is gone then: reading goes on at its title.
function goOn(name) {
  choose(name);
  $("#title").focus();
}

function showSteps() {
  redraw($("#steps"), [chosen, state.steps.map(({ state: { name, progress, note } }) => [name, progress, note])], () => state.steps.map((each, number) => {
    const { name, progress, note } = each.state, spoken = [`${number + 1}. ${each.title}`, READ[progress], note].filter(Boolean).join(", ");
    const button = element("button", "", { "data-step": name, "data-progress": progress, title: each.title, "aria-label": spoken });
    if (name === chosen) button.setAttribute("aria-current", "step");
    button.append(element("span", MARKS[progress] ?? `${number + 1}`, { class: "mark" }), element("span", each.title, { class: "name" }));
    const more = note || NAMED[progress];
    if (more) button.append(element("small", more));
    button.addEventListener("click", () => choose(name));
    const item = element("li");
    item.append(button);
    return item;
  }));
}

function changed(name, value) {
  typed[name] = value;
  showFields();
  showButtons();
  showStatus();
}

function tickBox({ name, label: title, hint }, box, ticked) {
  const label = element("label", "", { class: "check" }), text = element("span"), input = element("input", "", { type: "checkbox", name });
  input.checked = ticked;
  input.addEventListener("input", () => changed(name, input.checked ? box : ""));
  text.append(element("b", box), element("small", hint));
  label.append(input, text);
  label.title = title;
  return label;
}

// The server's answers must not overwrite what a person is typing.
function showFields() {
  const now = everything(), { boxes } = state;
  const asked = step().fields.filter(({ name, only }) => (only ? only[1].includes(now[only[0]]) : boxes[name] !== ""));
  redraw($("#fields"), [chosen, asked.map(({ name }) => [name, boxes[name]])], () => asked.map((field) => {
    if (boxes[field.name]) return tickBox(field, boxes[field.name], now[field.name] === boxes[field.name]);
    const label = element("label", field.label);
    const input = element(field.choices.length ? "select" : "input", "", { name: field.name, spellcheck: "false" });
    for (const choice of field.choices) input.append(element("option", choice, { value: choice }));
    input.value = now[field.name];
    input.addEventListener("input", () => changed(field.name, input.value));
    label.append(input);
    if (field.hint) label.append(element("span", field.hint));
    return label;
  }));
}

function button(text, act, kind, id, can = true) {
  const node = element("button", text, { type: "button", class: kind, id: `do-${id}` });
  node.disabled = Boolean(state.busy) || !can;
  node.addEventListener("click", () => order(act));
  return node;
}

function buttonsOf({ kind, button: name, state: { progress } }) {
  const now = capture(), order_ = (action) => () => post("capture", { step: chosen, action });
  const skips = chosen === "standing" && everything().reference_by !== "on the plate";
  const copies = everything()[{ intrinsics: "intrinsics_by", reference: "reference_by" }[chosen]] === "a file";
  if (kind === "form" || skips) return [button(skips || copies ? "Use it" : name, () => post("do", { step: chosen, values: said() }), "main", "step")];
  if (kind === "page") {
    return [button(name, async () => location.assign((await post("open", { step: chosen, values: said() })).url), "main", "step")];
  }
  if (kind === "run") {
    return state.monitor.running ? [button("Stop", () => post("stop", {}), "ask", "stop")] : [button(name, () => post("start", {}), progress === "waits" ? "" : "main", "step")];
  }
  if (!now?.running || now.ended) return [button(now?.ended ? "Start again" : name, () => post("capture", { step: chosen, action: "start", values: said() }), "main", "step")];
  return [
    now.itself ? button("Stop taking", order_("by_hand"), "ask", "by-hand") : button("Take automatically", order_("by_itself"), "main", "by-itself"),
    button("Take this one", order_("take"), "", "take", now.shown > 0),
    ...(now.live ? [] : [button("Next image", order_("next"), "", "next")]),
    button("Stop the camera", order_("stop"), "", "stop"),
  ];
}

function showButtons() {
  const { state: { progress, first } } = step(), later = state.steps.slice(state.steps.findIndex((each) => each.state.name === chosen) + 1);
  const next = ["done", "skipped"].includes(progress) && later.find((each) => each.state.progress !== "skipped");
  const before = state.steps.find((each) => each.state.name === first);
  const nodes = buttonsOf(step());
  // The one to press next stands out: the step's own while it isn't finished.
  const onwards = next && !taking() && !entered() && !capture()?.coverage?.wants.length;
  if (before || onwards) nodes.forEach((node) => node.classList.remove("main"));
  if (next) nodes.push(towards(`Next: ${next.title} →`, "on", next, onwards));
  if (before) nodes.unshift(towards(`First: ${before.title} →`, "first", before, true));
  const parts = nodes.map(({ id, textContent, className, disabled }) => [id, textContent, className, disabled]);
  redraw($("#buttons"), [chosen, first, next?.title, parts], () => nodes);
}

function towards(text, id, { state: { name } }, main) {
  const node = element("button", text, { type: "button", id: `do-${id}`, class: main ? "main" : "" });
  node.addEventListener("click", () => goOn(name));
  return node;
}

function status() {
  const { state: now, error } = step(), camera = capture(), { monitor } = state, own = $("#do-step")?.textContent;
  const wrong = refused || error;
  if (state.busy) return state.busy === chosen ? ["working …", ""] : [`working on another step (${state.busy}) …`, ""];
  if (wrong) return [wrong, "bad"];
  if (chosen === "run" && (monitor.running || monitor.ended)) {
    const last = monitor.lines.at(-1) ?? "";
    const seen = monitor.record;
    if (!seen) return monitor.running ? [last || "starting …", ""] : [last ? `${monitor.ended}: ${last}` : monitor.ended, "bad"];
    const why = seen.reason ? `: ${seen.reason}` : "", { protection } = seen;
    const bound = protection ? `, error at most ${(1e3 * protection.position_m).toFixed(2)} mm` : "";
    const text = `transform ${seen.verdict}${why}${bound}; ${seen.state}; frame ${seen.seq}`;
    return [monitor.running ? text : `${monitor.ended}; last: ${text}`, seen.verdict === "valid" ? "good" : "warn"];
  }
  if (camera && (camera.running || camera.ended)) return [camera.ended ? camera.note : `${camera.note}; ${camera.images.length} taken`, /^(taken|ready|no more)/.test(camera.note) ? "good" : "warn"];
  if (now.progress === "done" && own && entered()) return [`changed: press “${own}”`, ""];
  const words = { done: "done", stale: now.note, waits: now.note, skipped: `not needed: ${now.note}`, ready: "" };
  const text = words[now.progress] || "";
  return [text && now.note && now.progress === "done" ? `done: ${now.note}` : text || `not done yet: press “${own}”`, { done: "good", stale: "warn" }[now.progress] ?? ""];
}

function showStatus() {
  const [text, kind] = status();
  setText($("#status"), text);
  $("#status").dataset.kind = kind;
}

function showCapture() {
  const isOne = step().kind === "capture", now = capture();
  $("#capture").hidden = !isOne || !now;
  if (!isOne || !now) return;
  const views = now.coverage;
  $("#coverage").hidden = !views || chosen !== "plate";
  if (!$("#coverage").hidden) {
    const across = views.cells[0].length, cells = $("#cells"), tilts = $("#tilts");
    cells.setAttribute("viewBox", `0 0 ${across} ${views.cells.length}`);
    const cell = (seen, u, v) => shape("rect", { x: u + 0.03, y: v + 0.03, width: 0.94, height: 0.94, class: seen ? "seen" : "" });
    cells.replaceChildren(...views.cells.flatMap((row, v) => row.map((seen, u) => cell(seen, u, v))));
    const degrees = 180 / Math.PI, rings = [20, 45].map((r) => shape("circle", { r, class: "ring" }));
    const tilted = views.tilts.map(([x, y]) => shape("circle", { cx: x * degrees, cy: y * degrees, r: 4, class: "tilt" }));
    tilts.replaceChildren(...rings, shape("path", { d: "M-58 0H58M0-58V58" }), ...tilted);
    const wants = views.wants.map((text) => element("li", `still: ${text}`));
    $("#wants").replaceChildren(...(wants.length ? wants : [element("li", "enough to calibrate; more do no harm", { class: "enough" })]));
  }
  redraw($("#images"), [chosen, now.images], () => now.images.map((name) => {
    const item = element("li", name), drop = element("button", "✕", { type: "button", name, title: `delete ${name}`, "aria-label": `delete ${name}` });
    drop.addEventListener("click", () => order(() => post("capture", { step: chosen, action: "drop", name })));
    item.append(drop);
    return item;
  }));
}

async function load(image, path, count, key) {
  if (count === frame[key]) return;
  frame[key] = count;
  if (!count) { image.removeAttribute("src"); return; }
  image.src = `${path}?${count}`;
}

function showMonitor() {
  const now = state.monitor, isOne = step().kind === "run" && (now.running || now.ended !== null);
  $("#monitor").hidden = !isOne;
  if (!isOne) return;
  $("#mount").hidden = !now.mount || !now.running;
  if (now.mount) showMount($("#mount"), now.mount);
  const log = $("#log"), text = now.lines.join("\n");
  if (log.textContent !== text) { log.textContent = text; log.scrollTop = log.scrollHeight; }
}

function showResult() {
  const card = step();
  const lines = state.busy === chosen ? [] : card.said;
  $("#said").replaceChildren(...lines.filter(({ level }) => level).map(({ text, level }) => {
    const item = element("li", "", { "data-level": level });
    item.append(element("b", level), element("span", text));
    return item;
  }));
  // Rows of a table stay in one line each, sentences are broken.
  const output = lines.filter(({ level }) => !level).map(({ text }) => text);
  redraw($("#output"), output, () => output.map((text) => element("span", `${text}\n`, { class: /\S {2,}\S/.test(text) ? "row" : "" })));
  $("#file").hidden = chosen !== "target" || !card.state.files.includes("target.pdf");
  const image = $("#result img");
  const page = $("#result a");
  $("#result").hidden = !card.picture || Boolean(state.busy);
  if (card.picture && !state.busy) {
    image.hidden = card.picture.includes(".html?");
    page.hidden = !image.hidden;
    if (!page.hidden) page.setAttribute("href", card.picture);
    else if (image.getAttribute("src") !== card.picture) image.setAttribute("src", card.picture);
  }
}

function show() {
  const card = step();
  showSteps();
  $("#folder").textContent = state.folder;
  $("#folder").title = state.folder;
  $("#title").textContent = card.title;
  $("#about").textContent = card.about;
  // Broken between words only: within one it would break after "--".
  redraw($("#command code"), card.state.command, () => card.state.command.split(" ").filter(Boolean).flatMap((word) => [element("span", word), " "]).slice(0, -1));
  showFields();
  showButtons();
  showStatus();
  showCapture();
  showMonitor();
  showResult();
  document.body.dataset.busy = Boolean(state.busy);
  if (capture()) load($("#live"), "live.jpg", capture().shown, "live");
  if (step().kind === "run") load($("#shown"), "monitor.jpg", state.monitor.shown, "monitor");
}

async function order(act) {
  refused = "";
  document.body.dataset.busy = "true";
  try { await act(); } catch (error) { refused = error.message; }
  await refresh();
}

async function refresh() {
  clearTimeout(timer);
  if (ended) return;
  try {
    state = await get("state");
    show();
  } catch (error) {
    $("#status").textContent = error.message;
    $("#status").dataset.kind = "bad";
  }
  const lively = state?.busy || state?.monitor.running || (state?.capture?.running && !state.capture.ended);
  timer = setTimeout(refresh, lively ? LIVELY_MS : QUIET_MS);
}

async function done() {
  try { await post("done", {}); } catch (error) { refused = error.message; show(); return; }
  ended = true;
  over("gripmon setup has ended; this page may be closed. gripmon setup in the same folder continues.");
}

async function begin() {
  state = await get("state");
  const wanted = location.hash.slice(1);
  const open = state.steps.find((each) => ["ready", "stale"].includes(each.state.progress)) ?? state.steps.at(-1);
  chosen = state.steps.some((each) => each.state.name === wanted) ? wanted : open.state.name;
  $("#done").addEventListener("click", done);
  $("#fields").addEventListener("submit", (event) => { event.preventDefault(); $("#do-step")?.click(); });
  await refresh();
  document.body.dataset.ready = "true";
}

begin().catch((error) => { $("#status").textContent = error.message; $("#status").dataset.kind = "bad"; });
