// The page: asks /health every second, /path.json every other, and sends what a button says.
// Every address is relative: BlueOS serves the page under a path of its own.

import { drawPlan } from "./plan.js";
import { ago, capital, colourOf, colourOfDevice, coverageKey, coverageNote, factsNow, factsOfScale, flat } from "./words.js";

const LOOK_MS = 1000, PATIENCE_MS = 5000, PATH_EVERY = 2;
const POSSIBLE = { idle: ["start", "new"], mapping: ["stop", "finish", "new"], paused: ["start", "finish", "new"], finishing: [] };
const QUESTIONS = {
  finish: ["Finish this dive?", "The map is refined and the report written. It cannot be continued afterwards.", "Finish"],
  new: ["Begin a new dive?", "The dive of now is finished first; a new folder and a new map begin.", "New dive"],
};

const $ = id => document.getElementById(id);
const ask = (address, options = {}) =>
  fetch(address, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS), ...options });
const make = (name, text, className = "") => Object.assign(document.createElement(name), { textContent: text, className });

let looks = 0, plans = null, shownFrames = null, answered = false, sending = false;

function show(part) {
  document.querySelector("main").hidden = part !== "main";
  $("login").hidden = part !== "login";
  if (part !== "main") $("buttons").hidden = $("viewer").hidden = true;
}

function setState(text, colour, reason) {
  $("state").textContent = capital(text);
  $("state").className = `pill ${colour}`;
  $("reason").textContent = reason;
  document.title = `${text} · AquaFlow`;
}

function say(sentence) {
  $("message").textContent = capital(sentence);
  $("message").hidden = !sentence;
}

// --- what is shown -----------------------------------------------------------------------------

function fillList(list, rows) {
  $(list).replaceChildren(...rows.flatMap(([name, value]) => [make("dt", name), make("dd", value)]));
}

function showDive(dive) {
  const controlled = dive !== null && typeof dive === "object";
  $("buttons").hidden = !controlled;
  if (!controlled) {
    $("dive").textContent = dive ?? "";
    return;
  }
  const began = dive.begun_utc ? `, began ${dive.begun_utc.slice(11, 16)} UTC` : "";
  const frames = dive.frames ? `, ${dive.frames.toLocaleString("en")} frames` : "";
  $("dive").textContent = dive.name ? `${dive.name} (${dive.state}${began}${frames})` : "no dive";
  for (const button of $("buttons").children) {
    const possible = (POSSIBLE[dive.state] ?? []).includes(button.dataset.action);
    button.disabled = sending || !possible;
  }
  $("buttons").firstElementChild.textContent = dive.state === "paused" ? "Continue" : "Start";
}

function showDevices(devices) {
  const rows = Object.entries(devices ?? {});
  if (!rows.length) $("devices").replaceChildren(make("li", "none"));
  else $("devices").replaceChildren(...rows.map(([name, device]) => {
    const row = make("li", "");
    const said = [device.kind, device.state, device.reason].filter(Boolean).join(" · ");
    row.append(make("span", "", `dot ${colourOfDevice(device.state)}`), make("span", name), make("small", said));
    return row;
  }));
}

function showChanges(changes) {
  $("changes").replaceChildren(...(changes ?? []).slice(-6).reverse().map(change => {
    const row = make("li", "");
    row.append(make("time", ago(change.ago_s)), make("span", change.after), make("small", change.reason));
    return row;
  }));
}

function showViewer(viewer) {
  const here = ["localhost", "127.0.0.1", "[::1]"];
  const near = viewer && here.includes(viewer.host) && !here.includes(location.hostname);
  $("viewer").hidden = !viewer || !viewer.port || near;
  if (viewer) $("viewer").href = `http://${location.hostname}:${viewer.port}/`;
}

function showReport(report) {
  setState(report.state, colourOf(report.state, report.ok), report.reason);
  showDive(report.dive ?? null);
  showViewer(report.viewer);
  fillList("now", factsNow(report));
  fillList("scale", factsOfScale(report));
  showDevices(report.devices);
  showChanges(report.changes);
  if (document.querySelector(".all").open) {
    $("numbers").replaceChildren(...flat(report).map(([name, value]) => {
      const row = make("tr", "");
      row.append(make("td", name), make("td", value));
      return row;
    }));
  }
}

function showPicture(frames) {
  if (frames === shownFrames) return;
  shownFrames = frames;
  const picture = new Image();
  picture.alt = "The newest picture of the camera";
  picture.onload = () => {
    $("picture-frame").replaceChildren(picture);
    $("picture-note").textContent = frames > 0 ? `frame ${frames}` : "";
  };
  picture.src = `picture.jpg?frame=${frames}`;
}

function showCoverage(coverage, unit) {
  $("coverage").hidden = !coverage;
  $("hints").textContent = capital((plans?.hints ?? []).join("; "));
  if (!coverage) return;
  $("coverage-key").replaceChildren(...coverageKey(coverage, unit).map(([name, words]) => {
    const row = make("li", "");
    row.append(make("span", "", `swatch ${name}`), make("span", words));
    return row;
  }));
  $("coverage-note").textContent = coverageNote(coverage, unit);
}

function showPlan() {
  const parts = plans?.sub_maps ?? [];
  const choice = $("plan-choice");
  const wanted = choice.hidden || choice.value === "now" ? plans?.now?.sub_map : Number(choice.value);
  const plan = parts.find(part => part.number === wanted) ?? parts.at(-1);
  $("plan").hidden = plans === null;
  if (!plan) {
    $("plan-frame").replaceChildren(make("p", "No path yet"));
    showCoverage(null);
    return;
  }
  const now = plans.now?.sub_map === plan.number ? plans.now : null;
  drawPlan($("plan-frame"), plan, now, shownFrames);
  showCoverage(plan.coverage, plan.unit);
  $("plan-note").textContent = `seen ${plan.seen}; up: ${plan.up}`;
  const names = ["now", ...parts.map(part => String(part.number))];
  if (choice.options.length !== names.length) {
    choice.replaceChildren(...names.map(name => new Option(name === "now" ? "newest part" : `part ${Number(name) + 1}`, name)));
  }
  choice.hidden = parts.length < 2;
}

// --- asking ------------------------------------------------------------------------------------

async function look() {
  const answer = await ask("health");
  if (answer.status === 403) {
    show("login");
    return;
  }
  const report = await answer.json();
  show("main");
  showReport(report);
  showPicture(report.frames);
  if (looks++ % PATH_EVERY === 0) {
    const path = await ask("path.json");
    plans = path.ok ? await path.json() : null;
    showPlan();
  }
}

async function keepLooking() {
  try {
    if (!document.hidden) await look();
    answered = true;
  } catch (error) {
    if (!answered) show("main");
    setState("no answer", "bad", "The service does not answer; trying again.");
  }
  setTimeout(keepLooking, LOOK_MS);
}

async function send(action) {
  say("");
  sending = true;
  for (const button of $("buttons").children) button.disabled = true;
  try {
    const answer = await ask(`dive/${action}`, { method: "POST" });
    const said = await answer.json();
    if (!answer.ok) say(said.error ?? `The vehicle answered ${answer.status}.`);
  } catch (error) {
    say("The vehicle did not answer; what it does now is shown above.");
  }
  sending = false;
  await look().catch(() => {});
}

let decide = () => {};  // to the question that was asked last

function confirmed(action) {
  if (!QUESTIONS[action]) return true;
  const dialog = $("confirm");
  [$("question").textContent, $("consequence").textContent, $("agree").textContent] = QUESTIONS[action];
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise(resolve => decide = resolve);
}

$("confirm").addEventListener("close", () => {
  // The event comes some time after the closing: the next question may be open by then.
  if (!$("confirm").open) decide($("confirm").returnValue === "yes");
});

$("buttons").addEventListener("click", async event => {
  const action = event.target.dataset.action;
  if (action && await confirmed(action)) await send(action);
});

$("login").addEventListener("submit", async event => {
  event.preventDefault();
  const answer = await ask("login", { method: "POST", body: new URLSearchParams({ token: $("token").value }) }).catch(() => null);
  const refusal = answer === null ? "the vehicle does not answer" : (await answer.json()).error;
  $("refused").textContent = capital(refusal ?? "");
  if (answer?.ok) await look().catch(() => {});
});

$("plan-choice").addEventListener("change", showPlan);
addEventListener("resize", showPlan);
keepLooking();
