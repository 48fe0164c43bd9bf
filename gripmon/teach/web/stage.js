// The image with zoom and pan, and its overlay.  Pixel centres lie at whole coordinates.

import { shape } from "./page.js";

const ENLARGED = 10, SIGMAS = 3, LARGEST = 64, CLOSE = 5, LOUPE = 8;

function make(tag, attributes, parent) {
  const node = shape(tag, attributes);
  parent.append(node);
  return node;
}

export class Stage {
  constructor(root, calls) {
    this.root = root;
    this.calls = calls;
    this.canvas = root.querySelector("#image");
    this.overlay = root.querySelector("#overlay");
    this.loupe = root.querySelector("#loupe");
    this.bitmap = null;
    this.size = [1, 1];
    this.scale = 1;
    this.shift = [0, 0];
    this.fitted = true;
    this.drag = null;
    this.lines = make("g", {}, this.overlay);
    this.handleLayer = make("g", {}, this.overlay);
    this.handles = new Map();
    new ResizeObserver(() => (this.fitted ? this.fit() : this.draw())).observe(root);
    root.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    root.addEventListener("pointerdown", (event) => this.#down(event));
    root.addEventListener("pointermove", (event) => this.#move(event));
    root.addEventListener("pointerup", (event) => this.#up(event));
    root.addEventListener("pointercancel", () => this.#cancel());
  }

  begin(size, names) {
    this.size = size;
    for (const name of names) {
      const g = make("g", { class: "handle", "data-corner": name, role: "img", "aria-label": name }, this.handleLayer);
      make("circle", { class: "hit", r: 17 }, g);
      make("circle", { class: "halo", r: 8 }, g);
      make("circle", { class: "ring", r: 8 }, g);
      make("circle", { class: "chosen", r: 13 }, g);
      make("path", { class: "cross", d: "M-5 0h3.4M1.6 0h3.4M0-5v3.4M0 1.6v3.4" }, g);
      make("circle", { class: "dot", r: 1.3 }, g);
      make("text", { x: 13, y: -9 }, g).textContent = name;
      this.handles.set(name, g);
    }
    this.fit();
  }

  show(bitmap) { this.bitmap = bitmap; this.draw(); }

  // px of the image -> px of the stage, and back
  toStage([u, v]) { return [(u + 0.5) * this.scale + this.shift[0], (v + 0.5) * this.scale + this.shift[1]]; }
  toImage([x, y]) { return [(x - this.shift[0]) / this.scale - 0.5, (y - this.shift[1]) / this.scale - 0.5]; }

  #whole() {
    return Math.max(Math.min(this.root.clientWidth / this.size[0], this.root.clientHeight / this.size[1]), 1e-3);
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.root;
    this.scale = this.#whole();
    this.shift = [(width - this.scale * this.size[0]) / 2, (height - this.scale * this.size[1]) / 2];
    this.fitted = true;
    this.draw();
  }

  zoom(factor, about = [this.root.clientWidth / 2, this.root.clientHeight / 2]) {
    const before = this.toImage(about);
    this.scale = Math.min(Math.max(this.scale * factor, 0.5 * this.#whole()), LARGEST);
    const after = this.toStage(before);
    this.shift = [this.shift[0] + about[0] - after[0], this.shift[1] + about[1] - after[1]];
    this.fitted = false;
    this.draw();
  }

  // Enlarged relative to the scale at which the whole image fits, so that a corner keeps its surroundings.
  centre(at) {
    this.scale = Math.min(Math.max(this.scale, CLOSE * this.#whole()), LARGEST);
    this.shift = [0, 0];
    const [x, y] = this.toStage(at);
    this.shift = [this.root.clientWidth / 2 - x, this.root.clientHeight / 2 - y];
    this.fitted = false;
    this.draw();
  }

  // corners: [{name, at, state, ellipse}], reply: of the server or null
  update(corners, reply, selected) {
    this.corners = corners;
    this.reply = reply;
    this.selected = selected;
    this.draw();
  }

  draw() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; this.#drawNow(); });
  }

  #drawNow() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.root;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    const context = this.canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.setTransform(this.scale * ratio, 0, 0, this.scale * ratio, this.shift[0] * ratio, this.shift[1] * ratio);
    context.imageSmoothingEnabled = this.scale < 3;
    if (this.bitmap) context.drawImage(this.bitmap, 0, 0);
    this.#drawLines();
    this.#drawHandles();
    this.calls.viewed(this.scale);
  }

  #path(points) {
    return points.map((at, k) => `${k ? "L" : "M"}${this.toStage(at).map((v) => v.toFixed(2)).join(" ")}`).join("");
  }

  #drawLines() {
    this.lines.replaceChildren();
    if (!this.reply) return;
    const seen = this.reply.snapped;
    this.lines.setAttribute("class", seen.refused ? "rough" : "found");
    const outlines = Object.values(seen.outlines_px).map((line) => this.#path(line)).join("");
    make("path", { class: "outline", d: outlines }, this.lines);
    const dots = seen.edge_points_px.map((at) => `${this.#path([at])}h0`).join("");
    make("path", { class: "points", d: dots }, this.lines);
    for (const corner of seen.corners) {
      if (corner.covariance_px) this.#ellipse(corner.uv_px, corner.covariance_px);
    }
  }

  #ellipse(at, [[uu, uv], [, vv]]) {
    const mean = (uu + vv) / 2, half = Math.hypot((uu - vv) / 2, uv);
    const [x, y] = this.toStage(at);
    const size = SIGMAS * ENLARGED * this.scale;
    const turn = (90 / Math.PI) * Math.atan2(2 * uv, uu - vv);
    make("ellipse", {
      class: "ellipse", rx: size * Math.sqrt(mean + half), ry: size * Math.sqrt(Math.max(mean - half, 0)),
      transform: `translate(${x} ${y}) rotate(${turn})`,
    }, this.lines);
  }

  #drawHandles() {
    for (const { name, at, state } of this.corners ?? []) {
      const g = this.handles.get(name);
      const here = this.drag?.name === name ? this.drag.at : at;
      g.classList.toggle("selected", name === this.selected);
      g.classList.toggle("moving", this.drag?.name === name);
      if (!here) { g.setAttribute("visibility", "hidden"); continue; }
      g.removeAttribute("visibility");
      g.dataset.state = state;
      [g.dataset.u, g.dataset.v] = here.map((v) => v.toFixed(4));
      const [x, y] = this.toStage(here);
      g.setAttribute("transform", `translate(${x.toFixed(2)} ${y.toFixed(2)})`);
      // Near the right border its name stands on the left, and below where another corner's name would lie over it.
      const text = g.lastElementChild, width = 24 + 7 * name.length;
      const beside = this.corners.some((other) => other.name !== name && other.at && this.#isBeside([x, y], this.toStage(other.at), width));
      const before = x + width > this.root.clientWidth || (beside && x > width);
      text.setAttribute("x", before ? -13 : 13);
      text.setAttribute("y", beside ? 20 : -9);
      text.setAttribute("text-anchor", before ? "end" : "start");
    }
  }

  #isBeside([x, y], [a, b], width) { return a > x && a < x + width && Math.abs(b - y) < 18; }

  #here(event) {
    const box = this.root.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  // Handles lie close together when the image is small: take the nearest one.
  #under([x, y]) {
    let best = null, nearest = 17;
    for (const { name, at } of this.corners ?? []) {
      if (!at) continue;
      const [a, b] = this.toStage(at);
      const distance = Math.hypot(a - x, b - y) - (name === this.selected ? 3 : 0);
      if (distance < nearest) [best, nearest] = [{ name, at, grip: [a - x, b - y] }, distance];
    }
    return best;
  }

  #wheel(event) {
    if (event.target.closest("#help")) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    this.zoom(Math.exp(-Math.max(Math.min(event.deltaY * lines, 200), -200) * 0.0022), this.#here(event));
  }

  #down(event) {
    if (event.target.closest("#tools, #help") || event.button > 1) return;
    event.preventDefault();
    this.root.focus({ preventScroll: true });
    this.root.setPointerCapture(event.pointerId);
    const here = this.#here(event), found = event.button === 0 ? this.#under(here) : null;
    if (found) {
      this.drag = { name: found.name, at: found.at, from: here, grip: found.grip, moved: false };
      this.calls.select(found.name);
    } else {
      this.drag = { pan: here };
      this.root.classList.add("panning");
    }
  }

  #move(event) {
    const here = this.#here(event), drag = this.drag;
    if (!drag) { this.root.style.cursor = this.#under(here) ? "grab" : ""; return; }
    if (drag.pan) {
      this.shift = [this.shift[0] + here[0] - drag.pan[0], this.shift[1] + here[1] - drag.pan[1]];
      drag.pan = here;
      this.fitted = false;
    } else {
      drag.moved ||= Math.hypot(here[0] - drag.from[0], here[1] - drag.from[1]) > 2;
      if (!drag.moved) return;
      drag.at = this.toImage([here[0] + drag.grip[0], here[1] + drag.grip[1]]);
      this.#magnify(drag.at);
    }
    this.draw();
  }

  #up() {
    const drag = this.drag;
    this.#cancel();
    if (drag?.moved) this.calls.put(drag.name, drag.at);
    else if (drag?.name) this.calls.click(drag.name, drag.at);
  }

  #cancel() {
    this.drag = null;
    this.loupe.hidden = true;
    this.root.classList.remove("panning");
    this.draw();
  }

  #magnify([u, v]) {
    const size = this.loupe.width, context = this.loupe.getContext("2d"), middle = size / 2;
    this.loupe.hidden = false;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = "#0e1419";
    context.fillRect(0, 0, size, size);
    context.imageSmoothingEnabled = false;
    context.setTransform(LOUPE, 0, 0, LOUPE, middle - (u + 0.5) * LOUPE, middle - (v + 0.5) * LOUPE);
    if (this.bitmap) context.drawImage(this.bitmap, 0, 0);
    context.setTransform(1, 0, 0, 1, 0, 0);
    for (const [colour, width] of [["#000a", 3], ["#fff", 1]]) {
      [context.strokeStyle, context.lineWidth] = [colour, width];
      context.beginPath();
      for (const [x, y] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(middle + 4 * x, middle + 4 * y);
        context.lineTo(middle + 22 * x, middle + 22 * y);
      }
      context.stroke();
    }
  }
}
