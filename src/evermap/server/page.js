// The page of a server: everything comes as JSON with the token, and text from outside is set as text only.
"use strict";

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
let token = sessionStorage.getItem("evermap-token") || "";
let site = "", revisions = [], follows = null, asked = 0, compares = false; // with another than the one before
let operator = false, approved = 0, chosen = null, picks = 0; // how often a revision was chosen
let placed = [], told = [], whole = null, view = null, tile = null; // what is drawn, and which part of it

async function get(path, how = {}) {
  const headers = { Authorization: `Bearer ${token}`, "Content-Type": "application/json" };
  const answer = await fetch(path, { headers, ...how });
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).detail || answer.statusText);
  return answer;
}
const json = async (path) => (await get(path)).json();
const of = (path) => `/maps/${encodeURIComponent(site)}/${path}`;

function say(text) { $("state").textContent = text; }

// An operator's word: what it did is said at the foot of the page, and so is why it did not.
async function act(path, body, done) {
  try {
    const answer = await (await get(of(path), { method: "POST", body: JSON.stringify(body) })).json();
    $("said").textContent = done(answer);
    await Promise.all([refresh(path !== "approve"), beside()]);
    return true;
  } catch (error) { $("said").textContent = error.message; return false; }
}

function element(name, text, ...children) {
  const node = Object.assign(document.createElement(name), { textContent: text });
  node.append(...children);
  return node;
}

function button(text, act, label) {
  const node = Object.assign(element("button", text), { type: "button" });
  if (label) node.setAttribute("aria-label", label);
  node.addEventListener("click", act);
  return node;
}

function list(id, lines) {
  $(id).replaceChildren(...lines.map((line) => (typeof line === "string" ? element("li", line) : element("li", "", ...line))));
}

function table(id, heads, rows) {
  const cell = (text) => (typeof text === "string" ? element("td", text) : element("td", "", text));
  const lines = rows.map((row) => element("tr", "", ...row.map(cell)));
  const head = heads.map((text) => Object.assign(element("th", text), { scope: "col" }));
  $(id).replaceChildren(...(rows.length ? [element("thead", "", element("tr", "", ...head)), element("tbody", "", ...lines)] : []));
}

const minute = (stamp) => stamp.slice(0, 16).replace("T", " ");

function duration(s) {
  if (s === null) return "unknown";
  const [size, unit] = [[31557600, "years"], [86400, "days"], [3600, "h"], [60, "min"], [1, "s"]].find(([one]) => s >= one) || [1, "s"];
  return `${(s / size).toPrecision(2).replace(/e.*/, "")} ${unit}`;
}

function shape(name, values, kind) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(values)) node.setAttribute(key, value);
  node.setAttribute("class", kind);
  return node;
}

const percent = (p) => (p > 0.005 && p < 0.995 ? `${Math.round(100 * p)} %` : p < 0.5 ? "under 1 %" : "over 99 %");

function what(change, labels) {
  const names = change.landmarks.map((id) => labels.get(id) ?? String(id)).join(", ");
  const metres = change.displacement_m.every((x) => x !== null) ? Math.hypot(...change.displacement_m) : 0;
  const by = change.kind === "moved" ? ` by ${metres.toFixed(2)} m` : "";
  return `${names} ${change.kind}${by} (${percent(change.probability)})`;
}

// North is up: y of the map grows, y of the picture falls.
function draw(landmarks, changes) {
  [placed, told] = [landmarks.filter((one) => one.x_m !== null && !one.deleted), changes];
  let [left, right, low, high] = [0, 1, 0, 1];
  if (placed.length) [left, low] = [Infinity, Infinity], [right, high] = [-Infinity, -Infinity];
  for (const one of placed) {
    [left, right] = [Math.min(left, one.x_m), Math.max(right, one.x_m)];
    [low, high] = [Math.min(low, -one.y_m), Math.max(high, -one.y_m)];
  }
  const edge = Math.max(right - left, high - low, 1) / 20;
  whole = { x: left - edge, y: low - edge, w: right - left + 2 * edge, h: high - low + 2 * edge };
  if (!$("map").classList.contains("near")) view = { ...whole };
  paint();
}

const metre = () => Math.max(view.w / ($("map").clientWidth || 800), view.h / ($("map").clientHeight || 500)); // a pixel's

function paint() {
  const size = 5 * metre(), at = new Map(placed.map((one) => [one.landmark, one])), nodes = [];
  const kinds = new Map(told.flatMap((change) => change.landmarks.map((id) => [id, change.kind])));
  if (tile) nodes.push(shape("rect", { ...tile, "stroke-width": size / 3 }, "tile"));
  for (const one of placed) {
    const kind = kinds.get(one.landmark), x = one.x_m, y = -one.y_m;
    if (x < view.x - view.w || x > view.x + 2 * view.w || y < view.y - view.h || y > view.y + 2 * view.h) continue;
    const fresh = kind === "appeared" || kind === "returned", there = one.p_exists >= 0.5;
    const mark = one.landmark === chosen?.landmark ? "mark chosen" : "mark";
    let node;
    if (kind === "vanished") {
      const d = `M${x - size} ${y - size}l${2 * size} ${2 * size}m0 ${-2 * size}l${-2 * size} ${2 * size}`;
      node = shape("path", { d, "stroke-width": size / 2 }, `vanished ${mark}`);
    } else if (fresh) {
      node = shape("rect", { x: x - size, y: y - size, width: 2 * size, height: 2 * size, "stroke-width": 0 }, `new ${mark}`);
    } else {
      node = shape("circle", { cx: x, cy: y, r: size, "stroke-width": size / 4 }, `${there ? "there" : "gone"} ${mark}`);
      node.setAttribute("opacity", String(Math.max(0.15, there ? one.p_exists : 0.35)));
    }
    if (mark !== "mark") nodes.push(shape("circle", { cx: x, cy: y, r: 2 * size, "stroke-width": size / 2 }, "ring"));
    const title = document.createElementNS(SVG, "title");
    title.textContent = `${one.label} ${one.class || ""} ${percent(one.p_exists)}`;
    node.append(title);
    nodes.push(node);
  }
  for (const change of told.filter((one) => one.kind === "moved" && one.displacement_m.every((x) => x !== null))) {
    for (const one of change.landmarks.map((id) => at.get(id)).filter(Boolean)) {
      const [dx, dy] = change.displacement_m, [x, y] = [one.x_m, -one.y_m], turn = Math.atan2(-dy, dx);
      const tip = (angle) => `${x - 2 * size * Math.cos(turn + angle)} ${y - 2 * size * Math.sin(turn + angle)}`;
      const d = `M${x - dx} ${y + dy}L${x} ${y}M${tip(0.5)}L${x} ${y}L${tip(-0.5)}`;
      nodes.push(shape("path", { d, "stroke-width": size / 2 }, "moved"));
    }
  }
  $("map").setAttribute("viewBox", `${view.x} ${view.y} ${view.w} ${view.h}`);
  $("map").replaceChildren(...nodes);
}

// Show a part `scale` times as wide, with what is at [x, y] of the map at `to` afterwards.
function look(scale, [x, y] = [view.x + view.w / 2, view.y + view.h / 2], to = [x, y]) {
  const least = 50 * Math.max(view.w, view.h) * scale < Math.max(whole.w, whole.h) ? 1 : scale;
  const most = Math.min(least, Math.max(1, whole.w / view.w, whole.h / view.h));
  view = { x: x - (to[0] - view.x) * most, y: y - (to[1] - view.y) * most, w: view.w * most, h: view.h * most };
  view.x = Math.min(Math.max(view.x, whole.x - view.w / 2), whole.x + whole.w - view.w / 2);
  view.y = Math.min(Math.max(view.y, whole.y - view.h / 2), whole.y + whole.h - view.h / 2);
  $("map").classList.toggle("near", view.w < whole.w); // then one finger moves the map, and not the page
  requestAnimationFrame(paint);
}

function showAll() { view = { ...whole }; $("map").classList.remove("near"); paint(); }

function handle() {
  const map = $("map"), fingers = new Map();
  let drift = 0;
  const at = ([u, v]) => { const p = new DOMPoint(u, v).matrixTransform(map.getScreenCTM().inverse()); return [p.x, p.y]; };
  const middle = () => {
    const all = [...fingers.values()], mean = [0, 1].map((k) => all.reduce((sum, one) => sum + one[k], 0) / all.length);
    return [mean, all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 1];
  };
  map.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size === 1) drift = 0;
    map.setPointerCapture(event.pointerId);
  });
  map.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const [from, wide] = middle();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const [to, now] = middle();
    drift += Math.hypot(to[0] - from[0], to[1] - from[1]) + Math.abs(now - wide);
    if (drift > 6) look(wide / now, at(from), at(to));
  });
  map.addEventListener("pointerup", (event) => {
    if (fingers.size > 1 || drift > 6) return;
    const [x, y] = at([event.clientX, event.clientY]), far = (one) => Math.hypot(one.x_m - x, -one.y_m - y);
    const near = placed.reduce((best, one) => (best && far(best) <= far(one) ? best : one), null);
    if (near && far(near) < 24 * metre()) why(near.label);
  });
  for (const end of ["pointerup", "pointercancel"]) map.addEventListener(end, (event) => fingers.delete(event.pointerId));
  map.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && document.activeElement !== map) return; // the page scrolls
    event.preventDefault();
    look(Math.exp(Math.sign(event.deltaY) * 0.2), at([event.clientX, event.clientY]));
  }, { passive: false });
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  map.addEventListener("keydown", (event) => {
    if (event.key in steps) {
      const [dx, dy] = steps[event.key], [x, y] = [view.x, view.y];
      look(1, [x + (dx * view.w) / 8, y + (dy * view.h) / 8], [x, y]);
    } else if (event.key === "+" || event.key === "=") look(0.7);
    else if (event.key === "-") look(1 / 0.7);
    else if (event.key === "0") showAll();
    else return;
    event.preventDefault();
  });
  $("closer").addEventListener("click", () => look(0.5));
  $("farther").addEventListener("click", () => look(2));
  $("whole").addEventListener("click", showAll);
}

// P(exists) from look to look, as many as there were, not by time: a dot where it was seen, a cross where it was missed.
function history(answer) {
  const { hits, p_exists: belief } = answer.looks, [wide, tall] = [100, 30], nodes = [];
  const svg = shape("svg", { viewBox: `-6 -2 ${wide + 8} ${tall + 9}`, role: "img", "aria-label": answer.headline }, "history");
  const across = (k) => (wide * (k + 0.5)) / Math.max(hits.length, 1), xs = hits.map((_, k) => across(k));
  const ys = belief.map((p) => (p === null ? tall : tall * (1 - p)));
  const text = (x, y, words) => Object.assign(shape("text", { x, y }, "tick"), { textContent: words });
  for (const [y, words] of [[0, "1"], [tall / 2, "½"], [tall, "0"]]) {
    nodes.push(shape("path", { d: `M0 ${y}H${wide}` }, "rule"), text(-4, y + 1.2, words));
  }
  let first = 0;
  for (const one of answer.sessions) { // a line before each, with its revision
    const x = across(first - 0.5);
    nodes.push(shape("path", { d: `M${x} 0V${tall + 3}` }, "rule"));
    if (one.looks > hits.length / 20) nodes.push(text(x + 0.5, tall + 3, String(one.revision)));
    first += one.looks;
  }
  if (hits.length) nodes.push(shape("path", { d: `M${xs.map((x, k) => `${x} ${ys[k]}`).join("L")}` }, "belief"));
  const every = Math.ceil(hits.length / 300); // more are not to be told apart on so small a figure
  xs.forEach((x, k) => {
    if (k % every) return;
    const seen = hits[k] > 0, y = ys[k];
    const d = `M${x - 0.8} ${y - 0.8}l1.6 1.6m0 -1.6l-1.6 1.6`;
    nodes.push(seen ? shape("circle", { cx: x, cy: y, r: 0.8 }, "there") : shape("path", { d }, "vanished thin"));
  });
  nodes.push(text(0, tall + 6, `P(exists) in ${hits.length} looks, by revision: ● seen, ✕ missed`));
  svg.append(...nodes);
  return svg;
}

async function why(label) {
  try {
    chosen = await json(of(`landmarks/${encodeURIComponent(label)}/why?revision=${$("revision").value}`));
    const words = [chosen.headline, ...chosen.reasons].map((line) => element("p", line));
    $("why").replaceChildren(words[0], history(chosen), ...words.slice(1));
    $("word").hidden = !operator;
    $("pins").textContent = chosen.pinned ? `Unpin ${chosen.label}` : `Pin ${chosen.label}`;
    $("deletes").textContent = chosen.deleted ? `Undelete ${chosen.label}` : `Delete ${chosen.label}`;
    paint();
  } catch (error) { $("why").textContent = error.message; $("word").hidden = true; }
}

async function tell(action) {
  const body = { landmarks: [chosen.label], note: $("word-note").value };
  if (await act(action, body, (answer) => `${answer.note}: revision ${answer.revision}`)) {
    $("word-note").value = "";
    await why(chosen.label);
  }
}

// Chosen in a list, it is shown in another place: go there.
async function goTo(label) { await why(label); $("why-head").focus(); }

async function show() {
  const number = Number($("revision").value), mine = ++asked;
  $("before").max = String(number - 1);
  if (!compares) $("before").value = String(number - 1);
  const before = Number($("before").value);
  $("number").textContent = String(number);
  $("other").textContent = before ? String(before) : "an empty map";
  candidates();
  const item = revisions.find((one) => one.revision === number);
  if (!item) return;
  const [found, difference] = await Promise.all([json(of(`landmarks?revision=${number}`)), json(of(`diff?a=${before}&b=${number}`))]);
  if (mine !== asked) return; // the slider is elsewhere by now
  const labels = new Map(found.landmarks.map((one) => [one.landmark, one.label]));
  $("about").textContent = `${minute(item.created_at)} UTC: ${item.note || item.recording}; ${item.existing} of ${item.landmarks} landmarks exist`;
  $("names").replaceChildren(...found.landmarks.map((one) => new Option(one.label)));
  draw(found.landmarks, difference.changes);
  const line = (id, text) => [`${text} `, button("Why", () => goTo(labels.get(id) ?? String(id)), `Why: ${text}`)];
  const said = difference.edits.map((one) => line(one.landmark, `${labels.get(one.landmark) ?? one.landmark} ${one.what} by an operator`));
  const changed = difference.changes.map((one) => line(one.landmarks[0], what(one, labels)));
  list("changes", changed.length + said.length ? [...changed, ...said] : ["nothing"]);
}

// Revisions that are newer than the approved one; of the one that the slider is at, what has changed since that is shown.
function candidates() {
  const number = Number($("revision").value), newer = revisions.filter((one) => one.revision > approved);
  const lines = newer.slice(-100).reverse().map((one) => {
    const counts = Object.entries(one.changes).filter(([, count]) => count).map(([kind, count]) => `${count} ${kind}`);
    const from = one.robot ? `from ${one.robot}` : one.note || one.kind;
    const choose = button(`Revision ${one.revision}`, () => compare(one.revision, approved));
    choose.setAttribute("aria-pressed", String(one.revision === number));
    return [choose, ` ${minute(one.created_at)} ${from}: ${counts.join(", ") || "no change"}`];
  });
  const focused = [...$("candidates").querySelectorAll("button")].indexOf(document.activeElement);
  list("candidates", lines);
  if (focused >= 0) $("candidates").querySelectorAll("button")[focused]?.focus();
  $("approves").textContent = number === approved ? `Revision ${number} is approved` : `Approve revision ${number} for the robots`;
  $("approves").disabled = number === approved;
  $("reverts").textContent = `Revert to revision ${number}`;
  $("reverts").disabled = number === revisions.at(-1)?.revision;
}

function compare(number, before) {
  picks += 1;
  [compares, $("revision").value, $("before").max, $("before").value] = [before !== number - 1, String(number), String(number - 1), String(before)];
  show().catch((error) => say(error.message));
}

// Learned lifetimes; of a place, a button shows where that is.
function stays(lifetimes) {
  const place = ({ chunk, chunk_m: size }) => {
    if (!chunk) return "everywhere";
    const [x, y] = [chunk[0] * size, chunk[1] * size];
    const mark = () => {
      tile = { x, y: -y - size, width: size, height: size };
      paint();
      $("map").scrollIntoView({ block: "nearest" });
    };
    const text = `${x} to ${x + size} m, ${y} to ${y + size} m`;
    return button(text, mark, `Show on the map: ${text}`);
  };
  table("lives", ["Class", "Where (x, y)", "Half are gone after", "Stays seen, ended"], lifetimes.map((one) =>
    [one.class || "all", place(one), duration(one.half_gone_s), `${one.stays}, ${one.stays_that_ended}`]));
}

async function refresh(newest) {
  const before = picks, [log, learned] = await Promise.all([json(of("revisions")), json(of("lifetimes"))]);
  revisions = log;
  const head = revisions.length ? revisions[revisions.length - 1].revision : 0;
  $("revision").max = String(head);
  if (newest && picks === before) $("revision").value = String(head); // not if one was chosen meanwhile
  stays(learned.lifetimes);
  await show();
}

// What is beside the map: its approval, the robots, and the newest sessions.
async function beside() {
  const here = encodeURIComponent(site);
  const [[map], jobs, robots] = await Promise.all([json(`/maps?site=${here}`), json(`/jobs?most=20&site=${here}`), json("/robots")]);
  approved = map.approved ? map.approved.revision : 0;
  const newer = map.head - approved, who = map.approved ? `by ${map.approved.who}, ${minute(map.approved.at)}` : "";
  $("approved").textContent = `${approved ? `Revision ${approved} is approved (${who})` : "No revision is approved"}; ${newer > 0 ? `${newer} newer` : "none is newer"}.`;
  candidates();
  list("jobs", jobs.length ? jobs.map((job) => `${job.id} of ${job.robot}: ${job.state}${job.reason ? `, ${job.reason}` : ""}`) : ["none yet"]);
  const rows = robots.map((one) => {
    const held = one.maps.filter((item) => item.mapId === site);
    const used = held.find((item) => item.mapStatus === "ENABLED")?.mapVersion ?? "";
    return { ...one, used, held: held.map((item) => item.mapVersion).filter((version) => version !== used) };
  }).filter((one) => one.used || one.held.length).sort((a, b) => Number(b.used) - Number(a.used));
  const right = rows.filter((one) => one.used === String(approved)).length;
  $("holders").textContent = !rows.length ? "No robot has reported that it holds this map." : approved ? `${right} of ${rows.length} use revision ${approved}, which is approved.` : "";
  table("robots", ["Robot", "Uses", "Also holds", "Reported (UTC)"], rows.map((one) =>
    [one.robot, one.used ? `${one.used} ${one.used === String(approved) ? "✓ approved" : "△ another"}` : "none", one.held.join(", ") || "–", minute(one.at)]));
}

// Server-Sent Events by fetch, which can send the token.
async function follow() {
  if (follows) follows.abort();
  const { signal } = (follows = new AbortController());
  while (!signal.aborted) {
    try {
      const reader = (await get(of("events"), { signal })).body.pipeThrough(new TextDecoderStream()).getReader();
      await Promise.all([refresh($("revision").value === $("revision").max), beside()]); // what was missed meanwhile
      say("live");
      let text = "";
      for (let part = await reader.read(); !part.done; part = await reader.read()) {
        text += part.value;
        const end = text.lastIndexOf("\n\n") + 2, lines = text.slice(0, end);
        if (lines.includes("event: revision")) await refresh($("revision").value === $("revision").max);
        if (lines.includes("event: ")) await beside();
        if (end > 1) text = text.slice(end);
      }
    } catch (error) { if (signal.aborted) return; }
    say("the server does not answer; retrying");
    await new Promise((wake) => setTimeout(wake, 3000));
  }
}

async function choose() {
  [site, tile, chosen, compares] = [$("site").value, null, null, false];
  $("map").classList.remove("near");
  $("why").textContent = "Choose a landmark.";
  $("word").hidden = true;
  await beside();
  await refresh(true);
  const head = revisions.at(-1)?.revision ?? 0;
  if (approved && approved < head) compare(head, approved); // what waits for approval
  follow();
}

async function start() {
  try {
    const [sites, who] = await Promise.all([json("/sites"), json("/whoami")]);
    sessionStorage.setItem("evermap-token", token);
    operator = ["approve", "admin"].includes(who.role);
    $("enter").hidden = true;
    $("approve").hidden = !operator;
    if (!sites.length) { say("no map yet: upload a session"); return; }
    $("site").replaceChildren(...sites.map((name) => new Option(name)));
    $("choose").hidden = false;
    document.querySelector("main").hidden = false;
    await choose();
  } catch (error) { $("enter").hidden = false; say(error.message); }
}

const number = () => Number($("revision").value);
$("enter").addEventListener("submit", (event) => { event.preventDefault(); token = $("token").value; start(); });
$("find").addEventListener("submit", (event) => { event.preventDefault(); goTo($("name").value); });
$("approve").addEventListener("submit", async (event) => {
  event.preventDefault();
  const body = { revision: number(), note: $("approve-note").value };
  if (await act("approve", body, (answer) => `revision ${answer.approved.revision} is approved`)) $("approve-note").value = "";
});
$("reverts").addEventListener("click", async () => {
  const body = { revision: number(), note: $("approve-note").value };
  if (await act("revert", body, (answer) => `revision ${answer.revision} restores revision ${answer.restores}`)) $("approve-note").value = "";
});
$("pins").addEventListener("click", () => tell(chosen.pinned ? "unpin" : "pin"));
$("deletes").addEventListener("click", () => tell(chosen.deleted ? "undelete" : "delete"));
$("site").addEventListener("change", choose);
$("before").addEventListener("input", () => {
  compares = $("before").value !== $("before").max;
  show().catch((error) => say(error.message));
});
$("revision").addEventListener("input", () => {
  picks += 1;
  show().catch((error) => say(error.message));
});
handle();
if (token) start();
