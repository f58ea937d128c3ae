"use strict";
// Drawing of one frame: boxes over images, from above, and the scan in space. Boxes are (x, y, z, length, width,
// height, yaw) in the LiDAR frame: x forward, y to the left, z up.

const SVG = "http://www.w3.org/2000/svg";

function svg(name, attributes, ...children) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

function isObject(outcome) { return outcome === "missed" || outcome === "found"; }

// a shape that tells its reason when the mouse or the keyboard rests on it
function shape(node, box, index, hooks) {
  const colour = `var(--${box.outcome})`;
  node.setAttribute("class", `shape${isObject(box.outcome) ? " object" : ""}`);
  node.style.stroke = colour;
  node.style.fill = colour;
  node.dataset.box = index;
  node.setAttribute("tabindex", "0");
  node.setAttribute("role", "img");
  node.setAttribute("aria-label", box.text);
  node.addEventListener("pointerenter", () => hooks.enter(index));
  node.addEventListener("focus", () => hooks.enter(index));
  node.addEventListener("pointerleave", () => hooks.leave(index));
  return node;
}

function footprint([x, y, , length, width, , yaw]) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return [[.5, .5], [.5, -.5], [-.5, -.5], [-.5, .5]].map(([a, b]) =>
    [x + a * length * c - b * width * s, y + a * length * s + b * width * c]);
}

// bird's-eye view, forward up, in metres; rings every 10 m
function viewFromAbove(boxes, hooks) {
  const solid = boxes.map((box, index) => [box, index]).filter(([box]) => box.b);
  const corners = solid.flatMap(([box]) => footprint(box.b));
  const reach = (values, least) => Math.min(Math.max(least, ...values) + 2, 105);
  const ahead = reach(corners.map(c => c[0]), 25), behind = reach(corners.map(c => -c[0]), 1);
  const side = reach(corners.map(c => Math.abs(c[1])), 12);
  const text = (ahead + behind) / 32;
  const root = svg("svg", { viewBox: `${-side} ${-ahead} ${2 * side} ${ahead + behind}`, class: "above",
    role: "group", "aria-label": "bird's-eye view, forward is up" });
  for (let ring = 10; ring <= Math.max(ahead, side, behind); ring += 10) {
    root.append(svg("circle", { cx: 0, cy: 0, r: ring, fill: "none", stroke: "var(--line)", "vector-effect": "non-scaling-stroke" }));
    const mark = svg("text", { x: text / 4, y: -ring - text / 4, "font-size": text, fill: "var(--soft)" });
    mark.textContent = `${ring} m`;
    if (ring < ahead) root.append(mark);
  }
  root.append(svg("circle", { cx: 0, cy: 0, r: text / 3, fill: "var(--text)" }));
  for (const [box, index] of solid) {
    const points = footprint(box.b).map(([x, y]) => [-y, -x]);
    const front = [0, 1].map(k => (points[0][k] + points[1][k]) / 2);
    const group = svg("g", {},
      svg("polygon", { points: points.map(p => p.join(",")).join(" "), "vector-effect": "non-scaling-stroke" }),
      svg("line", { x1: -box.b[1], y1: -box.b[0], x2: front[0], y2: front[1], "vector-effect": "non-scaling-stroke" }));
    root.append(shape(group, box, index, hooks));
  }
  return root;
}

// boxes over an image; rectangles are (number of the box, x1, y1, x2, y2) in pixels
function viewInImage(image, rectangles, boxes, hooks) {
  const [width, height] = image.size;
  const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": `image of camera ${image.camera}` });
  root.append(svg("image", { href: image.src, width, height }));
  for (const [index, x1, y1, x2, y2] of rectangles) {
    if (!boxes[index] || x1 === null) continue;
    const rectangle = svg("rect", { x: x1, y: y1, width: x2 - x1, height: y2 - y1 });
    root.append(shape(rectangle, boxes[index], index, hooks));
  }
  return root;
}

function decodeScan(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Int16Array(bytes.buffer);
}

// the scan and the boxes in space: drag or arrow keys turn, wheel or + and - zoom
class ViewInSpace {
  constructor(scan, boxes) {
    this.points = decodeScan(scan);
    this.boxes = boxes.filter(box => box && box.b);
    this.turn = 0;
    this.tilt = .45;
    this.distance = 38;
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "the scan in space with boxes; arrow keys turn, plus and minus zoom");
    this.canvas.addEventListener("pointerdown", event => {
      this.last = [event.clientX, event.clientY];
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", event => {
      if (!this.last) return;
      this.rotate((event.clientX - this.last[0]) / 150, (event.clientY - this.last[1]) / 150);
      this.last = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, () => { this.last = null; });
    this.canvas.addEventListener("wheel", event => { event.preventDefault(); this.zoom(event.deltaY > 0 ? 1.12 : .89); }, { passive: false });
    this.canvas.addEventListener("keydown", event => {
      const step = { ArrowLeft: [-.1, 0], ArrowRight: [.1, 0], ArrowUp: [0, -.1], ArrowDown: [0, .1] }[event.key];
      const factor = { "+": .89, "=": .89, "-": 1.12 }[event.key];
      if (step) this.rotate(...step); else if (factor) this.zoom(factor); else return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  rotate(turn, tilt) {
    this.turn += turn;
    this.tilt = Math.min(1.5, Math.max(.03, this.tilt + tilt));
    this.draw();
  }

  zoom(factor) {
    this.distance = Math.min(150, Math.max(6, this.distance * factor));
    this.draw();
  }

  draw() {
    const scale = window.devicePixelRatio || 1;
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width) return;
    this.canvas.width = width * scale;
    this.canvas.height = height * scale;
    const context = this.canvas.getContext("2d");
    context.scale(scale, scale);
    const [ct, st, cp, sp] = [Math.cos(this.turn), Math.sin(this.turn), Math.cos(this.tilt), Math.sin(this.tilt)];
    const focal = Math.min(width, height) * 1.1;
    // the eye circles a place 14 m ahead of the LiDAR
    const project = (x, y, z) => {
      const dx = x - 14, dz = z + 1;
      // along the view, and to its right
      const u = dx * ct + y * st, v = dx * st - y * ct;
      const depth = this.distance + u * cp - dz * sp, up = u * sp + dz * cp;
      return depth < .5 ? null : [width / 2 + focal * v / depth, height / 2 - focal * up / depth, depth];
    };
    for (let i = 0; i < this.points.length; i += 3) {
      const z = this.points[i + 2] / 100;
      const p = project(this.points[i] / 100, this.points[i + 1] / 100, z);
      if (!p) continue;
      context.fillStyle = `hsl(${Math.round(215 - Math.min(1, Math.max(0, (z + 2) / 3.5)) * 175)} 75% 62%)`;
      context.fillRect(p[0], p[1], p[2] < 25 ? 1.8 : 1.2, p[2] < 25 ? 1.8 : 1.2);
    }
    const style = getComputedStyle(document.documentElement);
    context.lineWidth = 1.8;
    for (const box of this.boxes) {
      const [, , z, , , h] = box.b;
      const ends = [z - h / 2, z + h / 2].map(level => footprint(box.b).map(([x, y]) => project(x, y, level)));
      if (ends.flat().some(p => !p)) continue;
      context.strokeStyle = style.getPropertyValue(`--${box.outcome}`);
      context.setLineDash(isObject(box.outcome) ? [5, 4] : []);
      context.beginPath();
      for (let k = 0; k < 4; k++) {
        for (const [a, b] of [[ends[0][k], ends[0][(k + 1) % 4]], [ends[1][k], ends[1][(k + 1) % 4]], [ends[0][k], ends[1][k]]]) {
          context.moveTo(a[0], a[1]);
          context.lineTo(b[0], b[1]);
        }
      }
      context.stroke();
    }
  }
}
