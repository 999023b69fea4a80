// The page of a server: everything comes as JSON with the token, and text from outside is set as text only.
"use strict";

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
let token = sessionStorage.getItem("evermap-token") || "";
let site = "", revisions = [], follows = null, asked = 0, compares = false; // with another than the one before

async function get(path, signal) {
  const answer = await fetch(path, { headers: { Authorization: `Bearer ${token}` }, signal });
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).detail || answer.statusText);
  return answer;
}
const json = async (path) => (await get(path)).json();
const of = (path) => `/maps/${encodeURIComponent(site)}/${path}`;

function say(text) { $("state").textContent = text; }

function list(id, lines) {
  $(id).replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
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
  const placed = landmarks.filter((one) => one.x_m !== null && !one.deleted);
  const at = new Map(placed.map((one) => [one.landmark, one]));
  const xs = placed.map((one) => one.x_m), ys = placed.map((one) => -one.y_m);
  const [left, right] = [Math.min(...xs, 0), Math.max(...xs, 1)], [low, high] = [Math.min(...ys, 0), Math.max(...ys, 1)];
  const size = Math.max(right - left, high - low) / 120, nodes = [];
  const kinds = new Map(changes.flatMap((change) => change.landmarks.map((id) => [id, change.kind])));
  for (const one of placed) {
    const kind = kinds.get(one.landmark), x = one.x_m, y = -one.y_m;
    const fresh = kind === "appeared" || kind === "returned", there = one.p_exists >= 0.5;
    let node;
    if (kind === "vanished") {
      const d = `M${x - size} ${y - size}l${2 * size} ${2 * size}m0 ${-2 * size}l${-2 * size} ${2 * size}`;
      node = shape("path", { d, "stroke-width": size / 2 }, "vanished mark");
    } else if (fresh) {
      node = shape("rect", { x: x - size, y: y - size, width: 2 * size, height: 2 * size }, "new mark");
    } else {
      node = shape("circle", { cx: x, cy: y, r: size, "stroke-width": size / 4 }, `${there ? "there" : "gone"} mark`);
      node.setAttribute("opacity", String(Math.max(0.15, there ? one.p_exists : 0.35)));
    }
    const title = document.createElementNS(SVG, "title");
    title.textContent = `${one.label} ${one.class || ""} ${percent(one.p_exists)}`;
    node.append(title);
    node.setAttribute("tabindex", "0");
    node.setAttribute("role", "button");
    node.setAttribute("aria-label", title.textContent);
    node.addEventListener("click", () => why(one));
    node.addEventListener("keydown", (event) => { if (event.key === "Enter") why(one); });
    nodes.push(node);
  }
  for (const change of changes.filter((one) => one.kind === "moved" && one.displacement_m.every((x) => x !== null))) {
    for (const one of change.landmarks.map((id) => at.get(id)).filter(Boolean)) {
      const [dx, dy] = change.displacement_m, [x, y] = [one.x_m, -one.y_m], turn = Math.atan2(-dy, dx);
      const tip = (angle) => `${x - 2 * size * Math.cos(turn + angle)} ${y - 2 * size * Math.sin(turn + angle)}`;
      const d = `M${x - dx} ${y + dy}L${x} ${y}M${tip(0.5)}L${x} ${y}L${tip(-0.5)}`;
      nodes.push(shape("path", { d, "stroke-width": size / 2 }, "moved"));
    }
  }
  $("map").setAttribute("viewBox", `${left - 4 * size} ${low - 4 * size} ${right - left + 8 * size} ${high - low + 8 * size}`);
  $("map").replaceChildren(...nodes);
}

// P(exists) from look to look, as many as there were, not by time: a dot where it was seen, a cross where it was missed.
function history(told) {
  const { hits, p_exists: belief } = told.looks, [wide, tall] = [100, 30], nodes = [];
  const svg = shape("svg", { viewBox: `-6 -2 ${wide + 8} ${tall + 9}`, role: "img", "aria-label": told.headline }, "history");
  const across = (k) => (wide * (k + 0.5)) / Math.max(hits.length, 1), xs = hits.map((_, k) => across(k));
  const ys = belief.map((p) => (p === null ? tall : tall * (1 - p)));
  const text = (x, y, words) => Object.assign(shape("text", { x, y }, "tick"), { textContent: words });
  for (const [y, words] of [[0, "1"], [tall / 2, "½"], [tall, "0"]]) {
    nodes.push(shape("path", { d: `M0 ${y}H${wide}` }, "rule"), text(-4, y + 1.2, words));
  }
  let first = 0;
  for (const one of told.sessions) { // a line before each, with its revision
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

async function why(one) {
  try {
    const told = await json(of(`landmarks/${encodeURIComponent(one.label)}/why?revision=${$("revision").value}`));
    const lines = [told.headline, ...told.reasons];
    const words = lines.map((line) => Object.assign(document.createElement("p"), { textContent: line }));
    $("why").replaceChildren(words[0], history(told), ...words.slice(1));
  } catch (error) { $("why").textContent = error.message; }
}

async function show() {
  const number = Number($("revision").value), mine = ++asked;
  $("before").max = String(number - 1);
  if (!compares) $("before").value = String(number - 1);
  const before = Number($("before").value);
  $("number").textContent = String(number);
  $("other").textContent = before ? String(before) : "an empty map";
  const item = revisions.find((one) => one.revision === number);
  if (!item) return;
  const between = `diff?a=${before}&b=${number}`;
  const [found, told] = await Promise.all([json(of(`landmarks?revision=${number}`)), json(of(between))]);
  if (mine !== asked) return; // the slider is elsewhere by now
  const changes = told.changes;
  const labels = new Map(found.landmarks.map((one) => [one.landmark, one.label]));
  $("about").textContent = `${item.created_at}: ${item.note || item.recording}; ${item.existing} of ${item.landmarks} landmarks exist`;
  draw(found.landmarks, changes);
  list("changes", changes.length ? changes.map((one) => what(one, labels)) : ["nothing"]);
}

async function refresh(newest) {
  revisions = await json(of("revisions"));
  const head = revisions.length ? revisions[revisions.length - 1].revision : 0;
  $("revision").max = String(head);
  if (newest) $("revision").value = String(head);
  const jobs = await json(`/jobs?most=20&site=${encodeURIComponent(site)}`);
  list("jobs", jobs.map((job) => `${job.id} of ${job.robot}: ${job.state}${job.reason ? `, ${job.reason}` : ""}`));
  await show();
}

// Server-Sent Events by fetch, which can send the token.
async function follow() {
  if (follows) follows.abort();
  const mine = (follows = new AbortController());
  while (!mine.signal.aborted) {
    try {
      const reader = (await get(of("events"), mine.signal)).body.pipeThrough(new TextDecoderStream()).getReader();
      say("live");
      let text = "";
      for (let part = await reader.read(); !part.done; part = await reader.read()) {
        text += part.value;
        const end = text.lastIndexOf("\n\n") + 2;
        if (end > 1 && text.slice(0, end).includes("event: revision")) await refresh($("revision").value === $("revision").max);
        if (end > 1) text = text.slice(end);
      }
    } catch (error) { if (mine.signal.aborted) return; }
    say("the server is away; trying again");
    await new Promise((wake) => setTimeout(wake, 3000));
  }
}

async function choose() {
  site = $("site").value;
  await refresh(true);
  follow();
}

async function start() {
  try {
    const maps = await json("/maps");
    sessionStorage.setItem("evermap-token", token);
    $("enter").hidden = true;
    if (!maps.length) { say("no map yet: upload a session"); return; }
    $("site").replaceChildren(...maps.map((one) => new Option(one.site)));
    $("choose").hidden = false;
    document.querySelector("main").hidden = false;
    await choose();
  } catch (error) { $("enter").hidden = false; say(error.message); }
}

$("enter").addEventListener("submit", (event) => { event.preventDefault(); token = $("token").value; start(); });
$("site").addEventListener("change", choose);
$("before").addEventListener("input", () => {
  compares = $("before").value !== $("before").max;
  show().catch((error) => say(error.message));
});
$("revision").addEventListener("input", () => show().catch((error) => say(error.message)));
if (token) start();
