// Fingers, mouse and keys on the map: turn, move, come nearer, point.

const TURN = 4; // radians for the picture's height
const STILL_PX = 7; // a finger that moves less only points
const WHEEL = 0.0015;
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

// `changed()` after each movement, `rested()` after the last, `pointed(x, y)` for a click or tap.
export function hands(canvas, eye, { changed, rested, pointed }) {
  const down = new Map();
  let moved = 0, several = false;
  const spread = () => { const [a, b] = [...down.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  const middle = () => {
    const all = [...down.values()];
    return [0, 1].map(k => all.reduce((sum, at) => sum + (k ? at.y : at.x), 0) / all.length);
  };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    if (event.isPrimary) down.clear(); // one whose lifting was never told would count as a second finger
    if (!down.size) { moved = 0; several = false; }
    down.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
    if (down.size > 1) several = true;
  });
  canvas.addEventListener("pointermove", event => {
    const at = down.get(event.pointerId);
    if (!at) return;
    const before = { middle: middle(), spread: down.size > 1 ? spread() : 0 }, height = canvas.clientHeight;
    const [dx, dy] = [event.clientX - at.x, event.clientY - at.y];
    moved += Math.hypot(dx, dy);
    Object.assign(at, { x: event.clientX, y: event.clientY });
    if (moved < STILL_PX) return;
    if (down.size > 1) {
      const after = middle();
      eye.pan((after[0] - before.middle[0]) / height, (after[1] - before.middle[1]) / height);
      eye.zoom(Math.min(2, Math.max(0.5, before.spread / Math.max(spread(), 1))));
    } else if (at.button === 2 || event.shiftKey) eye.pan(dx / height, dy / height);
    else eye.turn(-TURN * dx / height * 0.7, -TURN * dy / height * 0.7);
    changed();
  });
  const up = event => {
    const at = down.get(event.pointerId);
    if (!at) return;
    down.delete(event.pointerId);
    if (down.size) return;
    if (moved < STILL_PX && !several && event.type === "pointerup") {
      const box = canvas.getBoundingClientRect();
      pointed(event.clientX - box.left, event.clientY - box.top);
    }
    rested();
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  let rest = 0;
  const soon = () => { clearTimeout(rest); rest = setTimeout(rested, 200); };
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    eye.zoom(Math.exp(WHEEL * Math.max(-300, Math.min(300, event.deltaY))));
    changed();
    soon();
  }, { passive: false });
  canvas.tabIndex = 0;
  canvas.setAttribute("aria-label", "The map: arrows turn it, plus and minus come nearer and go away");
  canvas.addEventListener("keydown", event => {
    const step = KEYS[event.key];
    if (step) eye.turn(0.1 * step[0], 0.1 * step[1]);
    else if (event.key === "+") eye.zoom(0.85);
    else if (event.key === "-") eye.zoom(1 / 0.85);
    else return;
    event.preventDefault();
    changed();
    soon();
  });
}
