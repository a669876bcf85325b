// The eye: where it is and where it looks. Axes as a camera's: x right, y down, z ahead.

const NEAREST = 0.15; // cosine between ahead and the vertical that turning leaves
const FOV = Math.PI / 3; // of the smaller side, while no camera's own is shown

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const add = (a, b, times = 1) => [a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = a => Math.hypot(...a);
export const unit = a => { const length = norm(a) || 1; return a.map(v => v / length); };

// Rotates `a` about the unit `axis`.
function turned(a, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(a.map(v => v * c), cross(axis, a), s), axis, dot(axis, a) * (1 - c));
}

// Columns of the rotation of a quaternion w, x, y, z.
export function axesOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

export class Eye {
  constructor(up) {
    Object.assign(this, { up, place: [0, 0, 0], target: [0, 0, 1], lens: null });
    this.axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  }

  get ahead() { return this.axes[2]; }

  // Looks from `place` to `target`, upright.
  look(place, target) {
    const ahead = unit(add(target, place, -1));
    let right = cross(ahead, this.up);
    if (norm(right) < 1e-3) right = cross(ahead, Math.abs(ahead[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
    right = unit(right);
    Object.assign(this, { place, target, lens: null, axes: [right, cross(ahead, right), ahead] });
  }

  // Takes a camera's pose and lens; turning begins about a point `range` ahead of it.
  take(place, wxyz, lens, range) {
    const axes = axesOf(wxyz);
    Object.assign(this, { place, axes, lens, target: add(place, axes[2], range) });
  }

  // Turns about the target: `dx`, `dy` in radians.
  turn(dx, dy) {
    this.upright();
    const steep = dot(turned(this.ahead, this.axes[0], dy), this.up);
    if (Math.abs(steep) > Math.sqrt(1 - NEAREST * NEAREST) && Math.sign(steep) === -Math.sign(dot(this.axes[1], this.up) * dy)) dy = 0;
    const all = a => turned(turned(a, this.axes[0], dy), this.up, dx);
    const back = all(add(this.place, this.target, -1));
    this.axes = this.axes.map(all);
    this.place = add(this.target, back);
  }

  // Leaves a camera's own roll and lens, so that the horizon stays level.
  upright() {
    if (this.lens) this.look(this.place, this.target);
  }

  // Moves along the picture: shares of its height.
  pan(dx, dy) {
    this.upright();
    const span = 2 * Math.tan(FOV / 2) * this.distance;
    const step = add(this.axes[0].map(v => -v * dx * span), this.axes[1], -dy * span);
    this.place = add(this.place, step);
    this.target = add(this.target, step);
  }

  get distance() { return norm(add(this.target, this.place, -1)); }

  // Nearer by a factor below one, farther by one above.
  zoom(factor) {
    this.upright();
    this.place = add(this.target, add(this.place, this.target, -1), factor);
  }

  // Focal lengths and centre in pixels of a picture of this size.
  optics(width, height) {
    const lens = this.lens;
    if (!lens) {
      const f = Math.min(width, height) / (2 * Math.tan(FOV / 2));
      return { fx: f, fy: f, cx: width / 2, cy: height / 2 };
    }
    const scale = Math.min(width / lens.width, height / lens.height); // all that the camera sees fits
    return {
      fx: lens.fx * scale, fy: lens.fy * scale,
      cx: width / 2 + (lens.cx - lens.width / 2) * scale, cy: height / 2 + (lens.cy - lens.height / 2) * scale,
    };
  }

  // [x, y, depth] in pixels; depth is not positive behind the eye.
  project(point, optics) {
    const away = add(point, this.place, -1);
    const [x, y, z] = this.axes.map(axis => dot(axis, away));
    return [optics.cx + optics.fx * x / z, optics.cy + optics.fy * y / z, z];
  }

  // The direction through a pixel.
  ray(px, py, optics) {
    const [x, y] = [(px - optics.cx) / optics.fx, (py - optics.cy) / optics.fy];
    return unit(this.axes[2].map((v, i) => v + x * this.axes[0][i] + y * this.axes[1][i]));
  }
}
