// Heights over the distance along a line, with their 95 % interval.

export function drawChart(svg, { along, height, low, high, unit }) {
  const [width, tall, left, below] = [264, 130, 44, 18];
  const [least, most] = [Math.min(...low), Math.max(...high)], length = along.at(-1) || 1;
  const x = v => left + (width - left - 4) * v / length, y = v => 6 + (tall - below - 12) * (most - v) / ((most - least) || 1);
  const make = (name, attributes, text) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };
  svg.setAttribute("viewBox", `0 0 ${width} ${tall}`);
  const at = values => values.map((v, i) => `${x(along[i])},${y(v)}`);
  svg.replaceChildren(
    make("polygon", { points: [...at(high), ...at(low).reverse()].join(" ") }),
    make("path", { d: `M${at(height).join("L")}` }),
    make("text", { x: 0, y: 14 }, most.toPrecision(3)), make("text", { x: 0, y: tall - below }, least.toPrecision(3)),
    make("text", { x: left, y: tall - 3 }, "0"), make("text", { x: width, y: tall - 3, "text-anchor": "end" }, `${length.toPrecision(3)} ${unit}`),
  );
}
