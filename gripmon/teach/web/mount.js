// How a camera must be moved to stand as at its reference: six bars, drawn into a node that keeps them.

import { element, setText } from "./page.js";

const LIMITS_SHOWN = 3;   // on each side of a bar's middle

const named = (tag, name) => element(tag, "", { class: name });

function bar() {
  const row = named("div", "move"), track = named("span", "track");
  track.append(named("i", "allowed"), named("i", "fill"));
  row.append(named("span", "end"), track, named("span", "end"), element("b"));
  return row;
}

export function showMount(root, mount) {
  if (!root.children.length) {
    root.append(named("p", "target"), named("p", "first"), named("p", "off"), named("div", "moves"));
    root.append(named("p", "directions"), named("p", "afterwards"));
  }
  const [target, first, off, moves, directions, afterwards] = root.children, [head, ...rest] = mount.summary.split(": ");
  root.dataset.kind = mount.placed ? "good" : mount.known ? "warn" : "bad";
  setText(target, `To stand as at ${mount.reference}; white: where the gripper will be seen`);
  setText(first, head);
  setText(off, rest.join(": "));
  setText(afterwards, mount.afterwards);
  setText(directions, mount.known ? `Shaded: alert limit. ${mount.directions}.` : "");
  while (moves.children.length > mount.rows.length) moves.lastChild.remove();
  while (moves.children.length < mount.rows.length) moves.append(bar());
  mount.rows.forEach((row, k) => {
    const [low, track, high, text] = moves.children[k].children, fill = track.lastChild;
    moves.children[k].dataset.done = mount.placed || row.done;
    setText(low, row.ends[0].split(" ")[1]);
    setText(high, row.ends[1].split(" ")[1]);
    setText(text, row.text);
    const half = 50 * Math.min(1, Math.abs(row.share) / LIMITS_SHOWN);
    fill.style.width = `${half}%`;
    fill.style.left = `${row.share < 0 ? 50 - half : 50}%`;
  });
}
