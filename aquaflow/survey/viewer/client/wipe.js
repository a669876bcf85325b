// The divider between two ways of seeing, moved by finger, mouse or arrow keys.

// Calls `moved(share)` with where it stands, of the picture's width.
export function divider(line, view, moved) {
  let share = 0.5;
  const put = to => {
    share = Math.min(0.99, Math.max(0.01, to));
    line.style.left = `${100 * share}%`;
    line.setAttribute("aria-valuenow", String(Math.round(100 * share)));
    moved(share);
  };
  const to = event => {
    const box = view.getBoundingClientRect();
    put((event.clientX - box.left) / Math.max(1, box.width));
  };
  line.setAttribute("aria-valuemin", "0");
  line.setAttribute("aria-valuemax", "100");
  line.addEventListener("pointerdown", event => {
    event.preventDefault();
    line.setPointerCapture(event.pointerId);
    line.focus();
  });
  line.addEventListener("pointermove", event => { if (line.hasPointerCapture(event.pointerId)) to(event); });
  line.addEventListener("keydown", event => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    put(share + step);
  });
  return () => put(share);
}
