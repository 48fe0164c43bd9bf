// What happens when: keys, pointer and buttons change the corners; the server says what follows; both are shown.

import { Corners } from "./history.js";
import { Stage } from "./stage.js";
import * as panel from "./panel.js";
import { $, get, over, picture, post, sentence } from "./page.js";

const LIVE_MS = 200, AGAIN_MS = 1000, NUDGED_MS = 150;

const corners = new Corners();
let state, stage, reply = null, chosen = null, selected = null, asking = false;
let busy = false, again = false, ended = false, timer = null;

// Without a gripper file: points on an edge beside the inner corners, for one of these at a time.
const HELPERS = ["outer", "end", "rise"];
const innerOf = (name) => HELPERS.reduce((to, helper) => to.replace(`_${helper}_`, "_inner_"), name);

function alone() {
  const has = (name) => corners.current.has(name);
  return state.corners.filter((name) => name.includes("_inner_") && has(name) && !HELPERS.some((other) => has(name.replace("inner", other))));
}

function wanted(name) {
  if (!state.corners_only || name.includes("_inner_")) return true;
  const open = alone(), mine = selected && innerOf(selected);
  return (open.includes(mine) ? mine : open[0]) === innerOf(name);
}

function shown(name) {
  const put = corners.current.get(name);
  const seen = reply?.snapped.corners.find((corner) => corner.name === name);
  const found = reply && !reply.snapped.refused;
  if (put?.hand && !state.corners_only) {
    const away = found && seen.uv_px ? Math.hypot(put.at[0] - seen.uv_px[0], put.at[1] - seen.uv_px[1]) : null;
    return { name, at: put.at, state: "hand", away };
  }
  if (found && seen.uv_px) return { name, at: seen.uv_px, state: put ? "measured" : "unplaced" };
  if (found) return { name, at: put?.at ?? seen.model_px, state: put ? "refused" : "idle" };
  if (put) return { name, at: put.at, state: "put" };
  return { name, at: wanted(name) ? (corners.current.size && seen?.model_px) || state.places[name] : null, state: "idle" };
}

function show() {
  const list = state.corners.map(shown);
  stage.update(list, reply, selected);
  panel.corners(state.corners_only ? list.filter(({ at }) => at) : list, reply, selected, (name) => { select(name); stage.root.focus(); });
  panel.jaw(reply, opening() !== null, state);
  panel.expected(reply, state);
  $("#undo").disabled = !corners.canUndo;
  $("#redo").disabled = !corners.canRedo;
  $("#clear").disabled = !corners.current.size;
  $("#save").disabled = busy || !(state.corners_only ? corners.current.size : reply);
  document.body.dataset.busy = busy || timer !== null;
}

function tell() {
  if (state.corners_only) {
    const todo = state.corners.filter((name) => name.includes("_inner_") && !corners.current.has(name)).length, open = alone();
    const wants = todo ? `${todo} of the 4 inner corners to go` : open.length ? `${open.join(", ")} still ${open.length > 1 ? "need" : "needs"} one` : "all are there";
    return panel.status(`Drag the inner corners, and for each an outer, end or rise point on its next edge: ${wants}. Without a gripper file corners don't snap to edges.`, todo || open.length ? "" : "good");
  }
  const missing = state.needed - corners.current.size;
  if (!corners.current.size && missing > 0) {
    panel.status(`Drag ${state.needed} corners onto the fingertips; the others follow by themselves.`);
  } else if (!reply) panel.status("looking…");
  else if (reply.snapped.refused) panel.status(sentence(reply.snapped.refused), missing > 0 ? "" : "warn");
  else {
    const { corners: all, share } = reply.snapped, measured = all.filter((corner) => corner.uv_px).length;
    const corners_ = all.length ? `${measured} of ${all.length} corners measured; ` : "";
    const found = `${corners_}${Math.round(100 * share)} % of the edges are inliers.`;
    panel.status(reply.reference ? found : `${found} ${reply.no_reference}`, reply.reference ? "good" : "warn");
  }
}

function opening() {
  const value = $("#opening").valueAsNumber;
  return Number.isFinite(value) && $("#opening").checkValidity() ? value / 1e3 : null;
}

function put() {
  const all = [...corners.current];
  return {
    corners: Object.fromEntries(all.map(([name, corner]) => [name, corner.at])),
    by_hand: all.filter(([, corner]) => corner.hand).map(([name]) => name),
    image: chosen, jaw_opening_m: state.has_jaw ? opening() : null,
  };
}

// One request at a time; meanwhile the newest one waits.
async function look() {
  clearTimeout(timer);
  timer = null;
  if (ended) return;
  if (state.corners_only) { tell(); show(); return; }
  if (busy) { again = true; return; }
  busy = true;
  show();
  try {
    do {
      again = false;
      reply = await post("look", put());
    } while (again);
    tell();
  } catch (error) {
    reply = null;
    panel.status(error.message, "bad");
  }
  busy = false;
  show();
}

function changed(later = 0) {
  if (asking) { asking = false; panel.saved(null, false, state); }
  clearTimeout(timer);
  timer = setTimeout(look, later);
  show();
}

function select(name) { selected = name; show(); }

function step(by) {
  const names = state.corners.filter((name) => shown(name).at), at = names.indexOf(selected);
  select(names[(at < 0 ? (by > 0 ? 0 : names.length - 1) : at + by + names.length) % names.length]);
}

function nudge(u, v) {
  if (!selected) return step(1);
  const { at } = shown(selected);
  if (!at) return;
  corners.put(selected, [at[0] + u, at[1] + v], true);
  changed(NUDGED_MS);
}

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function key(event) {
  const control = event.ctrlKey || event.metaKey, letter = event.key.toLowerCase();
  if (event.key === "Escape" && !$("#help").hidden) { help(); event.preventDefault(); return; }
  if (event.target.matches("input, select")) return;
  if (control && (letter === "y" || (letter === "z" && event.shiftKey))) { if (corners.redo()) changed(); }
  else if (control && letter === "z") { if (corners.undo()) changed(); }
  else if (control || event.altKey) return;
  else if (event.key === "+" || event.key === "=") stage.zoom(1.3);
  else if (event.key === "-") stage.zoom(1 / 1.3);
  else if (event.key === "0") stage.fit();
  else if (event.key === "?") help();
  else if (document.activeElement !== stage.root) return;
  else if (event.key in ARROWS) nudge(...ARROWS[event.key].map((v) => (event.shiftKey ? 0.1 : 1) * v));
  else if (event.key === "Tab") step(event.shiftKey ? -1 : 1);
  else if (event.key === "Escape") $("#save").focus();
  else if (event.key === "Enter" && selected && shown(selected).at) stage.centre(shown(selected).at);
  else if (letter === "s" && selected) { if (corners.release(selected)) changed(); }
  else if ((event.key === "Delete" || event.key === "Backspace") && selected) { if (corners.take(selected)) changed(); }
  else return;
  event.preventDefault();
}

function help() {
  $("#help").hidden = !$("#help").hidden;
  $("#keys").setAttribute("aria-expanded", String(!$("#help").hidden));
}

async function choose(number) {
  chosen = number;
  const one = state.pictures.find((each) => each.number === number);
  if (one && one.jaw_opening_m !== null) $("#opening").value = +(1e3 * one.jaw_opening_m).toFixed(4);
  try {
    if (number !== null) stage.show(await picture(`image/${number}.png`));
    await look();
  } catch (error) { panel.status(error.message, "bad"); }
}

// Refresh the live image while it is shown.
async function follow() {
  for (let count = 0; !ended; count += 1) {
    let pause = LIVE_MS;
    if (chosen === null) {
      try {
        const bitmap = await picture(`live.jpg?${count}`);
        if (chosen === null) stage.show(bitmap);
      } catch (error) { panel.status(error.message, "bad"); pause = AGAIN_MS; }
    }
    await new Promise((resolve) => setTimeout(resolve, pause));
  }
}

async function take() {
  try {
    state.pictures = await post("take", {});
    panel.pictures(state.pictures, state.live, chosen);
    panel.status(`${state.pictures.length} image${state.pictures.length > 1 ? "s" : ""} taken; three to ten, each in front of another background, are best.`, "good");
  } catch (error) { panel.status(error.message, "bad"); }
}

async function save() {
  if (!$("#help").hidden) help();
  busy = true;
  show();
  let result;
  try {
    result = await post("save", {
      put: put(), robot: $("#robot").value, camera_name: $("#camera").value, replace: asking,
      ...Object.fromEntries(["config", "taught", "corners"].map((kind) => [kind, state.saves.includes(kind) && $(`#save-${kind}`).checked])),
    });
  } catch (error) { result = { error: error.message }; }
  busy = false;
  if (result.refused) result.error = result.refused;
  asking = Boolean(result.exists?.length);
  panel.saved(result, asking, state);
  $("#save").scrollIntoView({ block: "nearest" });
  show();
}

async function done() {
  try { await post("done", {}); ended = true; if (state.back) location.assign(state.back); else over("gripmon teach has ended; this page may be closed."); } catch (error) { panel.status(error.message, "bad"); }
}

function connect() {
  document.addEventListener("keydown", key);
  const clicks = {
    undo: () => corners.undo() && changed(), redo: () => corners.redo() && changed(), clear: () => corners.clear() && changed(),
    "zoom-in": () => stage.zoom(1.3), "zoom-out": () => stage.zoom(1 / 1.3), fit: () => stage.fit(), keys: help, take, save, done,
  };
  for (const [id, act] of Object.entries(clicks)) $(`#${id}`).addEventListener("click", act);
  $("#opening").addEventListener("change", () => changed());
  $("#picture").addEventListener("change", (event) => choose(event.target.value === "" ? null : Number(event.target.value)));
  for (const id of ["save-config", "save-taught", "save-corners"]) {
    $(`#${id}`).addEventListener("change", () => { asking = false; panel.saved(null, false, state); });
  }
}

async function begin() {
  state = await get("state");
  stage = new Stage($("#stage"), {
    select,
    put: (name, at) => { corners.put(name, at, false); changed(); },
    // A click confirms the place of a corner that has followed the others.
    click: (name, at) => { if (!state.corners_only && shown(name).state === "idle" && corners.current.size) { corners.put(name, at, false); changed(); } },
    viewed: (scale) => { $("#zoom").textContent = `${Math.round(100 * scale)} %`; },
  });
  stage.begin([state.width_px, state.height_px], state.corners);
  panel.begin(state);
  connect();
  const first = state.live ? null : state.pictures[0].number;
  panel.pictures(state.pictures, state.live, first);
  tell();
  show();
  stage.root.focus({ preventScroll: true });
  await choose(first);
  if (state.live) follow();
  document.body.dataset.ready = "true";
}

begin().catch((error) => panel.status(error.message, "bad"));
