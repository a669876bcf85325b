"""The page at / : the report as a table, read again every two seconds; no foreign scripts."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>AquaFlow</title>
<meta name="viewport" content="width=device-width">
<style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em; max-width: 60em; color: #123; }
td { padding: 0 1.5em 0 0; vertical-align: top; } td:first-child { color: #567; }
h1 { font-weight: 500; } .ok { color: #17803d; } .bad { color: #b42318; }
</style></head><body>
<h1 id="state">AquaFlow</h1><p id="reason"></p><table id="facts"></table>
<script>
const text = value => typeof value === "object" && value !== null
  ? Object.entries(value).map(([k, v]) => k + ": " + text(v)).join(", ") : String(value);
const heard = sources => Object.entries(sources).flatMap(([source, kinds]) =>
  Object.entries(kinds).map(([kind, now]) => [source + " " + kind.replaceAll("_", " "),
    [now.value].flat().join(", ") + " " + now.unit + ", " + now.age_s + " s ago"]));
async function look() {
  try {
    const report = await (await fetch("health")).json();
    const state = document.getElementById("state");
    state.textContent = report.state; state.className = report.ok ? "ok" : "bad";
    document.getElementById("reason").textContent = report.reason;
    const facts = document.getElementById("facts"); facts.replaceChildren();
    for (const [name, value] of Object.entries(report)) {
      if (name === "state" || name === "reason") continue;
      const rows = name === "telemetry" ? heard(value) : [[name.replaceAll("_", " "), text(value)]];
      for (const cells of rows) {
        const row = facts.insertRow();
        for (const cell of cells) row.insertCell().textContent = cell;
      }
    }
  } catch (error) { document.getElementById("state").textContent = "no answer"; }
}
look(); setInterval(look, 2000);
</script></body></html>
"""
"""Holds no data itself: its script asks for /health."""
