// The panel beside the image: words and numbers only.

import { $, element, sentence } from "./page.js";

const mm = (m) => (1e3 * m >= 0.0995 ? (1e3 * m).toFixed(2) : (1e3 * m).toFixed(3));
const degrees = (rad) => ((180 / Math.PI) * rad).toFixed(3);

const basename = (path) => path.split(/[\\/]/).pop();

export function status(text, kind = "") {
  $("#status").textContent = text;
  $("#status").dataset.kind = kind;
}

export function begin(state) {
  $("#subject").textContent = state.gripper;
  $("#subject").title = state.reference ? `reference ${state.reference}` : "no reference yet: the corners give one";
  $("#robot").value = state.robot;
  $("#camera").value = state.camera_name;
  $("#names").hidden = state.fixed_names || !state.saves.includes("config");
  for (const kind of ["config", "taught", "corners"]) {
    const code = $(`#save-${kind}`).parentElement.querySelector("code");
    code.textContent = basename(state.files[kind]);
    code.title = state.files[kind];
    code.closest("label").hidden = !state.saves.includes(kind);
  }
  $("#folder").textContent = `\u200e${state.folder}`; // cut at its beginning, but read from left to right
  $("#folder").title = state.folder;
  document.body.classList.toggle("rough", state.corners_only);
  $("#names-drawn").toggleAttribute("hidden", !state.corners_only); // SVG has no property for it
  if (state.corners_only) {
    $("#help-snap").hidden = $("#help-snap").nextElementSibling.hidden = true;
    for (const kind of ["config", "taught"]) $(`#save-${kind}`).parentElement.hidden = true;
    for (const part of ["#save-corners", "#corners thead", "#expected", "#legend"]) $(part).hidden = true;
    saved(null, false, state);
  }
  $("#jaw").hidden = !state.has_jaw;
  [$("#opening").min, $("#opening").max] = [1e3 * state.jaw_m[0], 1e3 * state.jaw_m[2]];
}

export function pictures(list, live, chosen) {
  $("#pictures").hidden = list.length < 2 && !live;
  $("#take").hidden = !live;
  const options = list.map((one) => element("option", one.name, { value: one.number }));
  if (live) options.unshift(element("option", `live: ${live}`, { value: "" }));
  $("#picture").replaceChildren(...options);
  $("#picture").value = chosen ?? "";
}

export function corners(list, reply, selected, choose) {
  const replies = new Map((reply?.snapped.corners ?? []).map((corner) => [corner.name, corner]));
  $("#corners").parentElement.hidden = !list.length; // round tips have none
  $("#corners tbody").replaceChildren(...list.map(({ name, state, away }) => {
    const row = element("tr", "", { "data-corner": name });
    row.classList.toggle("selected", name === selected);
    const mark = element("td");
    mark.append(element("span", "", { class: "mark", "data-state": state }));
    row.append(mark, element("td", name));
    const corner = replies.get(name);
    if (state === "hand") {
      const off = away === null ? "" : `, ${away.toFixed(2)} px from the edges`;
      row.append(element("td", `set by hand${off}`, { colspan: 2, class: "quiet" }));
    } else if (corner?.sigma_px != null) {
      const agree = element("td", "", { title: `${Math.round(100 * corner.inliers)} % of its edges' search lines are inliers` });
      const meter = element("meter", "", { min: 0, max: 1, low: 0.4, high: 0.6, optimum: 1, value: corner.inliers });
      agree.append(meter, ` ${Math.round(100 * corner.inliers)} %`);
      row.append(element("td", corner.sigma_px.toFixed(3)), agree);
    } else {
      const text = reply && !reply.snapped.refused ? corner?.reason ?? "" : state === "put" ? "placed" : "not placed yet";
      row.append(element("td", text, { colspan: 2, class: state === "refused" ? "reason" : "quiet" }));
    }
    row.addEventListener("click", () => choose(name));
    return row;
  }));
}

export function jaw(reply, given, state) {
  if (!state.has_jaw) return;
  const note = $("#opening-note");
  note.classList.toggle("warn", !given);
  if (given) note.textContent = "";
  else if (reply && !reply.snapped.refused) {
    const { jaw_opening_m: opening_m, jaw_sigma_m: sigma_m } = reply.snapped, seen = `${(1e3 * opening_m).toFixed(2)} ± ${mm(sigma_m)} mm`;
    note.textContent = `The image shows ${seen}, but it can hardly separate that from the distance: better use what the robot reports.`;
  } else note.textContent = "Better use what the robot reports than what the image shows.";
}

export function expected(reply, state) {
  const values = reply?.expected, reference = reply?.reference;
  $("#expected").hidden = !values;
  if (!values) return;
  const { expected: sigma, drift, recalibration } = values.accuracy;
  const rows = [
    ["one frame ±", sigma.tcp_m.map(mm), "mm"],
    ["smallest drift", drift.smallest.tcp_m.map(mm), "mm"],
    ["rotation ±", sigma.rotation_rad.map(degrees), "°"],
    ["smallest turn", drift.smallest.rotation_rad.map(degrees), "°"],
  ];
  if (reference && !state.reference) rows.push(["reference ±", [0, 7, 14].map((k) => mm(Math.sqrt(reference.covariance[k]))), "mm"]);
  const weakest = sigma.tcp_m.indexOf(Math.max(...sigma.tcp_m));
  $("#accuracy tbody").replaceChildren(...rows.map(([name, numbers, unit], k) => {
    const row = element("tr");
    const cells = numbers.map((text, axis) => element("td", text, k < 2 && axis === weakest ? { class: "weakest" } : {}));
    row.append(element("td", name), ...cells, element("td", unit));
    return row;
  }));
  $("#promise").textContent = sentence(values.promise);
  $("#promise").classList.toggle("warn", !values.reachable);
  const delays = drift.delay_frames["0.0001"].map((frames, k) => `${"xyz"[k]} ${frames === null ? "never" : `within ${frames} frames`}`);
  const notes = [`A step of the TCP by 0.1 mm is detected on average: ${delays.join(", ")}.`];
  if (reply.pose?.rival) notes.push("Another pose explains these corners as well: place one outside of their plane.");
  if (reference && !state.reference) notes.push("The reference comes from these corners; a plate (gripmon calibrate plane) measures it more accurately.");
  if (recalibration.reason) notes.push(`No new pose from corners later: ${recalibration.reason}.`);
  $("#expected-note").textContent = notes.join(" ");
}

export function saved(result, asking, state) {
  const lines = [];
  if (result?.error) lines.push(element("p", result.error, { class: "warn" }));
  for (const path of result?.exists ?? []) lines.push(element("p", `${path} is there already.`, { class: "warn" }));
  for (const [path, what] of Object.entries(result?.written ?? {})) lines.push(element("p", `✓ ${what}: ${basename(path)}`, { class: "good", title: path }));
  for (const note of result?.notes ?? []) lines.push(element("p", note));
  if (result?.next) {
    const line = element("p", "next: ");
    line.append(element("code", result.next));
    lines.push(line);
  }
  $("#saved").replaceChildren(...lines);
  $("#save").textContent = asking ? "Replace what is there" : state.corners_only ? "Save corners" : "Save";
  $("#save").className = asking ? "ask" : "main";
}
