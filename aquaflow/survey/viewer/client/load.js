// The map's chunks as the server packs them (aquaflow/survey/viewer/packing.py), turned into texels.

export const WORDS = 8; // of 32 bits, two texels for each Gaussian; the last three are its place

// Words and places of the Gaussians in one chunk.
export function unpacked(bytes, count, about) {
  const shorts = new Uint16Array(bytes, 0, 3 * count), rest = new Uint8Array(bytes, 6 * count);
  const columns = 8 + 3 + about.levels.length;
  if (rest.length !== columns * count) throw new Error("the map came damaged");
  const column = k => rest.subarray(k * count, (k + 1) * count);
  const [qw, qx, qy, qz, s0, s1, s2, alpha, r, g, b] = Array.from({ length: 11 }, (_, k) => column(k));
  const none = new Uint8Array(count), levels = [0, 1, 2].map(k => k < about.levels.length ? column(11 + k) : none);
  const words = new Uint32Array(WORDS * count), places = new Float32Array(3 * count), floats = new Float32Array(words.buffer);
  for (let i = 0, w = 0; i < count; i++, w += WORDS) {
    words[w + 1] = (s0[i] << 16) | (s1[i] << 24);
    words[w + 2] = s2[i] | (alpha[i] << 8) | (r[i] << 16) | (g[i] << 24);
    words[w + 3] = b[i] | (levels[0][i] << 8) | (levels[1][i] << 16) | (levels[2][i] << 24);
    words[w + 4] = qw[i] | (qx[i] << 8) | (qy[i] << 16) | (qz[i] << 24);
    for (let k = 0; k < 3; k++) {
      const u = shorts[k * count + i] * (4 / 65535) - 2, far = Math.min(Math.abs(u), 1.9999);
      floats[w + 5 + k] = places[3 * i + k] = about.middle[k] + about.half[k] * (far < 1 ? u : Math.sign(u) / (2 - far));
    }
  }
  return { words, places };
}

export async function asked(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(answer.status === 403 ? "The token is missing: open the viewer with it." : `${address}: ${answer.status}`);
  return answer;
}

// A chunk on its way.
export const chunk = (about, number) => fetch(`/map/${about.version}/${number}`);

// Gets the chunks one after the other, the first of which is `coming`; `put(unpacked, first, end)`
// after each. The next one comes while one is unpacked. False if the server shows another map by now.
export async function loadMap(about, coming, put) {
  for (let number = 0, first = 0; number < about.ends.length; number++) {
    const answer = await coming;
    if (answer.status === 404) return false;
    if (!answer.ok) throw new Error(`the map: ${answer.status}`);
    const bytes = await answer.arrayBuffer();
    const end = about.ends[number];
    if (number + 1 < about.ends.length) coming = chunk(about, number + 1);
    put(unpacked(bytes, end - first, about), first, end);
    first = end;
  }
  return true;
}

// Asks a tool of the server; an Error with its sentence where it refuses.
export async function tell(tool, given) {
  const answer = await fetch(`/${tool}`, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(given),
  });
  const said = await answer.json();
  if (!answer.ok) throw new Error(said.error);
  return said;
}
