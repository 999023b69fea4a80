// The page of a server: everything comes as JSON with the token, and text from outside is set as text only.
"use strict";

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
let token = sessionStorage.getItem("evermap-token") || "";
let site = "", revisions = [], follows = null, asked = 0, compares = false; // with another than the one before
let order = [], clock = "unix"; // revisions by the time of the world that they show, and the clock of that
let operator = false, approved = 0, chosen = null, picks = 0; // how often a revision was chosen
let placed = [], told = [], fleet = [], held = []; // landmarks, changes, robots on the map, and what robots report
let whole = null, view = null, tile = null; // which part is drawn
let kinds = [], marks = [], hovered = null, searched = new Set(), painting = false; // classes as in the legend
const MOST_NAMES = 30, RADIUS = 5; // names on the map at once, and half of a landmark's size in pixels

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
  const roled = (node, role) => { node.setAttribute("role", role); return node; }; // as cards, on a phone, it is a table, too
  const cell = (text, k) => {
    const node = roled(typeof text === "string" ? element("td", text) : element("td", "", text), "cell");
    node.dataset.head = heads[k]; // said beside it on a phone
    return node;
  };
  const lines = rows.map((row) => roled(element("tr", "", ...row.map(cell)), "row"));
  const head = heads.map((text) => roled(Object.assign(element("th", text), { scope: "col" }), "columnheader"));
  roled($(id), "table");
  $(id).replaceChildren(...(rows.length ? [element("thead", "", roled(element("tr", "", ...head), "row")), element("tbody", "", ...lines)] : []));
}

const minute = (stamp) => stamp.slice(0, 16).replace("T", " ");

// A time of the map's clock.
function moment(s) {
  if (s === null || !Number.isFinite(s)) return "before all sessions";
  if (clock === "recording") return `${s.toFixed(1)} s`;
  const date = new Date(1000 * s);
  return Number.isNaN(date.getTime()) ? `${s} s` : minute(date.toISOString());
}

// Revisions by the time that they show: that of the newest session in each. One that came late shows no earlier time.
function sorted(log) {
  const at = new Map([[0, -Infinity]]);
  for (const one of log) {
    const shows = at.get(one.restores ?? one.parent) ?? -Infinity;
    at.set(one.revision, Math.max(shows, one.stamp_to_s ?? -Infinity));
  }
  const all = log.map((one) => ({ ...one, shows: at.get(one.revision), late: one.stamp_to_s !== null && one.stamp_to_s < at.get(one.revision) }));
  return all.sort((a, b) => (a.shows === b.shows ? a.revision - b.revision : a.shows - b.shows));
}

const at = (id) => order[Number($(id).value) - 1]; // undefined of the empty map
const place = (revision) => order.findIndex((one) => one.revision === revision) + 1;
const number = () => at("time")?.revision ?? 0;
const head = () => revisions.at(-1)?.revision ?? 0;

function point(id, revision) { $(id).value = String(place(revision)); }

// What a slider is at, beside it and for who hears it.
function tellTime(id, text) { $(id === "time" ? "when" : "other").textContent = text; $(id).setAttribute("aria-valuetext", text); }

const called = (one) => `${moment(one.shows)}, revision ${one.revision}${one.revision === head() ? ", the newest" : ""}`;

// What a revision did, in words.
function deed(one) {
  const note = one.note === `back to revision ${one.restores}` ? "" : one.note; // unless somebody gave another
  if (one.restores !== null) return `goes back to ${one.restores ? `revision ${one.restores}` : "the empty map"}${note ? `: ${note}` : ""}`;
  if (one.kind === "edit") return one.note || "edited by an operator";
  const counts = Object.entries(one.changes).filter(([, count]) => count).map(([kind, count]) => `${count} ${kind}`);
  if (one.grown) counts.push(`${one.grown} seen for the first time`);
  return counts.join(", ") || "nothing has changed";
}

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
  const names = change.landmarks.map((id, k) => labels.get(id) ?? change.names?.[k] ?? String(id)).join(", ");
  const metres = change.displacement_m.every((x) => x !== null) ? Math.hypot(...change.displacement_m) : 0;
  const degrees = Math.abs((change.rotation_rad ?? 0) * 180 / Math.PI), moves = ["moved", "rotated"].includes(change.kind);
  const turned = moves && degrees >= 17, inPlace = turned && metres < 0.1; // the limits of a living map
  const by = [turned ? `turned by ${degrees.toFixed(0)}°${inPlace ? " in place" : ""}` : "", moves && !inPlace ? `moved by ${metres.toFixed(2)} m` : ""];
  return `${names} ${moves ? by.filter(Boolean).join(" and ") : change.kind} (${percent(change.probability)})`;
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
  for (const one of fleet.filter((robot) => robot.x_m !== null)) {
    if (!placed.length) [left, right, low, high] = [one.x_m - 1, one.x_m + 1, -one.y_m - 1, -one.y_m + 1];
    [left, right] = [Math.min(left, one.x_m), Math.max(right, one.x_m)];
    [low, high] = [Math.min(low, -one.y_m), Math.max(high, -one.y_m)];
  }
  const edge = Math.max(right - left, high - low, 1) / 20;
  whole = { x: left - edge, y: low - edge, w: right - left + 2 * edge, h: high - low + 3 * edge }; // a scale fits below
  if (!$("map").classList.contains("near")) view = { ...whole };
  hovered = null;
  legend();
  search();
}

const metre = () => Math.max(view.w / ($("map").clientWidth || 800), view.h / ($("map").clientHeight || 500)); // a pixel's

function kindOf(change, k) { // of a replacement the first ones are gone
  if (change.kind !== "replaced") return change.kind;
  return k < change.landmarks.length / 2 ? "vanished" : "appeared";
}

// Shapes of classes, with 1 as half of their size. Of 35 classes no two have the same shape and colour.
const polygon = (points) => `M${points.join("L")}Z`;
const regular = (count, first) => polygon(Array.from({ length: count }, (_, k) => first + (2 * Math.PI * k) / count).map((a) => [1.15 * Math.cos(a), 1.15 * Math.sin(a)]));
const CIRCLE = "M-1 0a1 1 0 1 0 2 0a1 1 0 1 0 -2 0Z", CROSS = [[-1, -0.35], [-0.35, -0.35], [-0.35, -1], [0.35, -1], [0.35, -0.35], [1, -0.35]];
const SHAPES = [CIRCLE, polygon([[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]]), regular(3, -Math.PI / 2), regular(4, 0),
  polygon([...CROSS, ...CROSS.map(([x, y]) => [-x, -y])]), regular(3, Math.PI / 2), regular(6, 0)];
const COLOURS = 5; // of classes, in page.css
const looks = (name) => { const k = kinds.indexOf(name); return [k % SHAPES.length, k % COLOURS]; };

// Landmarks, on a canvas below the rest: of those thousands are drawn in a frame. A landmark is faint where it probably
// does not exist, and hollow where it is believed gone.
function paintMarks() {
  const canvas = $("marks"), map = $("map"), ink = getComputedStyle(canvas), dots = window.devicePixelRatio || 1, m = metre();
  const [wide, tall] = [map.clientWidth, map.clientHeight];
  if (canvas.width !== Math.round(wide * dots) || canvas.height !== Math.round(tall * dots)) [canvas.width, canvas.height] = [Math.round(wide * dots), Math.round(tall * dots)];
  const pen = canvas.getContext("2d"), size = RADIUS * dots, shapes = SHAPES.map((d) => new Path2D(d));
  const colours = Array.from({ length: COLOURS }, (_, k) => ink.getPropertyValue(`--c${k}`));
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.clearRect(0, 0, canvas.width, canvas.height);
  pen.lineWidth = 0.3;
  for (const { at: [x, y], look: [form, colour], there, opacity } of marks) {
    const [u, v] = [(x - view.x - view.w / 2) / m + wide / 2, (y - view.y - view.h / 2) / m + tall / 2];
    pen.setTransform(size, 0, 0, size, u * dots, v * dots);
    pen.globalAlpha = opacity;
    pen.fillStyle = pen.strokeStyle = colours[colour];
    if (there) pen.fill(shapes[form]);
    else pen.stroke(shapes[form]);
  }
}

function paint() {
  painting = false;
  const size = RADIUS * metre(), of = new Map(placed.map((one) => [one.landmark, one])), nodes = [], named = [];
  const changed = new Map(told.flatMap((change) => change.landmarks.map((id, k) => [id, kindOf(change, k)])));
  const seen = placed.filter(({ x_m: x, y_m: y }) => x > view.x - size && x < view.x + view.w + size && -y > view.y - size && -y < view.y + view.h + size);
  const few = seen.length <= MOST_NAMES;
  if (tile) nodes.push(shape("rect", { ...tile, "stroke-width": size / 3 }, "tile"));
  marks = seen.map((one) => {
    const kind = changed.get(one.landmark), [x, y] = [one.x_m, -one.y_m], mine = one.landmark === chosen?.landmark;
    const opacity = Math.max(one.p_exists, 0.2); // still to be found
    if (kind === "vanished") {
      const d = `M${x - size} ${y - size}l${2 * size} ${2 * size}m0 ${-2 * size}l${-2 * size} ${2 * size}`;
      nodes.push(shape("path", { d, "stroke-width": size / 2 }, "vanished"));
    } else if (kind === "appeared" || kind === "returned") {
      const at = { x: x - 1.8 * size, y: y - 1.8 * size, width: 3.6 * size, height: 3.6 * size };
      nodes.push(shape("rect", { ...at, "stroke-width": size / 2, opacity }, "new"));
    }
    if (mine) nodes.push(shape("circle", { cx: x, cy: y, r: 2.4 * size, "stroke-width": size / 2 }, "ring"));
    if (one === hovered || mine || few || searched.has(one)) named.push(one);
    return { at: [x, y], look: looks(one.class || ""), there: one.p_exists >= 0.5 && kind !== "vanished", opacity };
  });
  for (const change of told.filter((one) => one.kind === "moved" && one.displacement_m.every((x) => x !== null))) {
    for (const one of change.landmarks.map((id) => of.get(id)).filter(Boolean)) {
      const [dx, dy] = change.displacement_m, turn = Math.atan2(-dy, dx), short = Math.min(1.5 * size, Math.hypot(dx, dy) / 2);
      const [x, y] = [one.x_m - short * Math.cos(turn), -one.y_m - short * Math.sin(turn)]; // the landmark stays visible
      const tip = (angle) => `${x - 2 * size * Math.cos(turn + angle)} ${y - 2 * size * Math.sin(turn + angle)}`;
      const d = `M${one.x_m - dx} ${dy - one.y_m}L${x} ${y}M${tip(0.5)}L${x} ${y}L${tip(-0.5)}`;
      nodes.push(shape("path", { d, "stroke-width": 1.2 * size }, "halo"), shape("path", { d, "stroke-width": size / 2 }, "moved"));
    }
  }
  nodes.push(...robots(size)); // their names come before those of landmarks
  for (const one of named.slice(0, MOST_NAMES)) {
    const left = one.x_m > view.x + 0.75 * view.w, words = one === hovered ? `${one.label} ${about(one)}` : one.label;
    const node = label(one.x_m + (left ? -1.6 : 1.6) * size, -one.y_m - 1.2 * size, size, words);
    node.setAttribute("class", "label name");
    if (left) node.setAttribute("text-anchor", "end");
    nodes.push(node);
  }
  $("map").setAttribute("viewBox", `${view.x} ${view.y} ${view.w} ${view.h}`);
  $("map").replaceChildren(...nodes, ...scale(size));
  paintMarks();
}

const about = (one) => `${one.label.startsWith(one.class || "") ? "" : `${one.class}, `}${percent(one.p_exists)}`;

// Several moves of a finger between two frames are drawn once.
function repaint() { if (!painting) { painting = true; requestAnimationFrame(paint); } }

// Which class looks like what, and how many of it exist.
function legend() {
  for (const name of [...new Set(placed.map((one) => one.class || ""))].sort()) if (!kinds.includes(name)) kinds.push(name);
  const counts = kinds.map((name) => placed.filter((one) => (one.class || "") === name && one.p_exists >= 0.5).length);
  $("classes").replaceChildren(...kinds.map((name, k) => {
    const [form, colour] = looks(name), svg = shape("svg", { viewBox: "-1.5 -1.5 3 3", "aria-hidden": "true" }, "symbol");
    svg.append(shape("path", { d: SHAPES[form] }, `c${colour}`));
    return element("span", "", svg, ` ${name || "without a class"}, ${counts[k]}`);
  }));
}

// The landmark nearest to a place, if that is within so many pixels of it.
function nearest([x, y], pixels) {
  const far = (one) => Math.hypot(one.x_m - x, -one.y_m - y);
  const near = placed.reduce((best, one) => (best && far(best) <= far(one) ? best : one), null);
  return near && far(near) < pixels * metre() ? near : null;
}

// Name on the map what is typed: all landmarks that are called so, or begin so, or are of that class.
function search() {
  const text = $("name").value.trim().toLowerCase(), starts = (one) => one.toLowerCase().startsWith(text);
  searched = new Set(text ? placed.filter((one) => starts(one.label) || starts(one.class || "")) : []);
  repaint();
}

function label(x, y, size, words) {
  return Object.assign(shape("text", { x, y, "font-size": 2.6 * size, "stroke-width": 0.6 * size }, "label"), { textContent: words });
}

// Robots where their newest sessions ended, pointing ahead, with their paths; names of those at one place are listed.
function robots(size) {
  const nodes = [], names = [], seen = [];
  for (const one of fleet.filter((robot) => robot.x_m !== null)) {
    const [x, y] = [one.x_m, -one.y_m], corner = (angle, r) => `${x + r * size * Math.cos(one.heading_rad + angle)} ${y - r * size * Math.sin(one.heading_rad + angle)}`;
    const path = shape("path", { d: `M${one.path_m.map(([u, v]) => `${u} ${-v}`).join("L")}`, "stroke-width": size / 3 }, "path");
    const mark = shape("path", { d: `M${corner(0, 2.6)}L${corner(2.5, 2.2)}L${corner(Math.PI, 0.9)}L${corner(-2.5, 2.2)}Z`, "stroke-width": size / 3 }, "robot");
    const title = document.createElementNS(SVG, "title");
    title.textContent = `${one.robot || "a robot"}, ${moment(one.stamp_s)}, revision ${one.revision}`;
    mark.append(title);
    const beside = seen.filter(([u, v]) => Math.hypot(u - x, v - y) < 6 * size).length;
    seen.push([x, y]);
    nodes.unshift(path);
    nodes.push(mark);
    const left = x > view.x + 0.7 * view.w, name = label(x + (left ? -3.2 : 3.2) * size, y + (1 + 3 * beside) * size, size, one.robot || "a robot");
    if (left) name.setAttribute("text-anchor", "end");
    names.push(name);
  }
  return [...nodes, ...names];
}

// A bar of 1, 2 or 5 times a power of ten metres.
function scale(size) {
  const about = 24 * size, power = 10 ** Math.floor(Math.log10(about)), long = power * [5, 2, 1].find((one) => one * power <= about);
  const [x, y] = [view.x + 2 * size, view.y + view.h - 2 * size];
  const bar = shape("path", { d: `M${x} ${y - size}v${size}h${long}v${-size}`, "stroke-width": size / 3 }, "scale");
  return [bar, label(x + long + size, y, size, long < 1 ? `${Math.round(100 * long)} cm` : `${long} m`)];
}

// Show a part `scale` times as wide, with what is at [x, y] of the map at `to` afterwards.
function look(scale, [x, y] = [view.x + view.w / 2, view.y + view.h / 2], to = [x, y]) {
  const least = 50 * Math.max(view.w, view.h) * scale < Math.max(whole.w, whole.h) ? 1 : scale;
  const most = Math.min(least, Math.max(1, whole.w / view.w, whole.h / view.h));
  view = { x: x - (to[0] - view.x) * most, y: y - (to[1] - view.y) * most, w: view.w * most, h: view.h * most };
  view.x = Math.min(Math.max(view.x, whole.x - view.w / 2), whole.x + whole.w - view.w / 2);
  view.y = Math.min(Math.max(view.y, whole.y - view.h / 2), whole.y + whole.h - view.h / 2);
  $("map").classList.toggle("near", view.w < whole.w); // then one finger moves the map, and not the page
  repaint();
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
    if (!fingers.has(event.pointerId)) {
      const near = event.pointerType === "mouse" ? nearest(at([event.clientX, event.clientY]), 12) : null;
      if (near !== hovered) { hovered = near; repaint(); }
      return;
    }
    const [from, wide] = middle();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const [to, now] = middle();
    drift += Math.hypot(to[0] - from[0], to[1] - from[1]) + Math.abs(now - wide);
    if (drift > 6) look(wide / now, at(from), at(to));
  });
  map.addEventListener("pointerup", (event) => {
    if (fingers.size > 1 || drift > 6) return;
    const near = nearest(at([event.clientX, event.clientY]), 24);
    if (near) why(near.label);
  });
  map.addEventListener("pointerleave", () => { if (hovered) { hovered = null; repaint(); } });
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
  const svg = shape("svg", { viewBox: `-6 -2 ${wide + 8} ${tall + 11}`, role: "img", "aria-label": answer.headline }, "history");
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
  nodes.push(text(0, tall + 7.5, `P(exists) in ${hits.length} looks, by revision: ● seen, ✕ missed`));
  svg.append(...nodes);
  return svg;
}

async function why(label) {
  try {
    chosen = await json(of(`landmarks/${encodeURIComponent(label)}/why?revision=${number()}`));
    const words = [chosen.headline, ...chosen.reasons].map((line) => element("p", line));
    $("why").replaceChildren(words[0], history(chosen), ...words.slice(1));
    $("word").hidden = !operator;
    $("pins").textContent = chosen.pinned ? `Unpin ${chosen.label}` : `Pin ${chosen.label}`;
    $("deletes").textContent = chosen.deleted ? `Undelete ${chosen.label}` : `Delete ${chosen.label}`;
    $("word-name").value = chosen.label;
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

async function rename() {
  const body = { landmark: chosen.label, name: $("word-name").value, note: $("word-note").value };
  let label = chosen.label;
  if (await act("rename", body, (answer) => { label = answer.label; return `${answer.note}: revision ${answer.revision}`; })) {
    $("word-note").value = "";
    await why(label);
  }
}

// Chosen in a list, it is shown in another place: go there.
async function goTo(label) { await why(label); $("why-head").focus(); }

async function show() {
  const item = at("time"), mine = ++asked;
  if (!item) return;
  if (!compares) point("before", item.parent);
  const before = at("before")?.revision ?? 0, shown = item.revision;
  tellTime("time", called(item));
  tellTime("before", before ? called(at("before")) : "an empty map");
  candidates();
  let found, difference, here;
  try {
    [found, difference, here] = await Promise.all(
      [`landmarks?revision=${shown}`, `diff?a=${before}&b=${shown}`, `poses?revision=${shown}`].map((path) => json(of(path))));
  } catch (error) {
    if (mine === asked) { [fleet, placed, told] = [[], [], []]; $("about").textContent = error.message; list("changes", []); draw([], []); }
    return;
  }
  if (mine !== asked) return; // the slider is elsewhere by now
  [fleet, clock] = [here.robots, found.clock];
  tellTime("time", called(item));
  tellTime("before", before ? called(at("before")) : "an empty map");
  const labels = new Map(found.landmarks.map((one) => [one.landmark, one.label]));
  const from = item.robot ? ` of ${item.robot}` : "", late = item.late ? `, of ${moment(item.stamp_to_s)}, which came late` : "";
  const origin = item.kind === "session" ? `${item.recording || "a session"}${from}${late}` : deed(item);
  $("about").textContent = `Entered ${minute(item.created_at)} UTC: ${origin}; ${item.existing} of ${item.landmarks} landmarks exist`;
  $("names").replaceChildren(...found.landmarks.map((one) => new Option(one.label)));
  draw(found.landmarks, difference.changes);
  tableOfRobots();
  const line = (id, text) => [`${text} `, button("Why", () => goTo(labels.get(id) ?? String(id)), `Why: ${text}`)];
  const said = difference.edits.map((one) => line(one.landmark, `${labels.get(one.landmark) ?? one.landmark} ${one.what} by an operator`));
  const changed = difference.changes.map((one) => line(one.landmarks[0], what(one, labels)));
  const fresh = difference.grown.map((id) => labels.get(id) ?? String(id)), more = fresh.length > 12 ? ` and ${fresh.length - 12} more` : "";
  const grown = fresh.length ? [`seen for the first time, ${fresh.length}: ${fresh.slice(0, 12).join(", ")}${more}`] : [];
  const back = item.restores !== null ? [`revision ${shown} ${deed(item)}`] : [];
  const all = [...back, ...changed, ...said, ...grown];
  list("changes", all.length ? all : ["nothing"]);
}

// Revisions that are newer than the approved one; of the one that the slider is at, what has changed since that is shown.
function candidates() {
  const shown = number(), newer = revisions.filter((one) => one.revision > approved);
  const lines = newer.slice(-100).reverse().map((one) => {
    const choose = button(`Revision ${one.revision}`, () => compare(one.revision, approved));
    choose.setAttribute("aria-pressed", String(one.revision === shown));
    const time = one.stamp_to_s === null ? minute(one.created_at) : moment(one.stamp_to_s);
    return [choose, ` ${time}${one.robot ? ` from ${one.robot}` : ""}: ${deed(one)}`];
  });
  const focused = [...$("candidates").querySelectorAll("button")].indexOf(document.activeElement);
  list("candidates", lines);
  if (focused >= 0) $("candidates").querySelectorAll("button")[focused]?.focus();
  $("approves").textContent = shown === approved ? `Revision ${shown} is approved` : `Approve revision ${shown} for the robots`;
  $("approves").disabled = shown === approved;
  $("reverts").textContent = `Revert to revision ${shown}`;
  $("reverts").disabled = shown === head();
}

function compare(revision, before) {
  picks += 1;
  point("time", revision);
  point("before", before);
  compares = before !== at("time").parent;
  show();
}

// Learned lifetimes; of a place, a button shows where that is.
function stays(lifetimes) {
  const where = ({ chunk, chunk_m: size }) => {
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
    [one.class || "all", where(one), duration(one.half_gone_s), `${one.stays}, ${one.stays_that_ended}`]));
}

async function refresh(newest) {
  const before = picks, [log, learned] = await Promise.all([json(of("revisions")), json(of("lifetimes"))]);
  const shown = number(), other = at("before")?.revision ?? 0;
  revisions = log;
  order = sorted(log);
  $("time").max = $("before").max = String(order.length);
  point("time", newest && picks === before ? head() : shown); // not the newest if one was chosen meanwhile
  point("before", other);
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
  tableOfJobs(jobs);
  held = robots;
  tableOfRobots();
}

const STATES = { queued: "… waits", working: "… is entered", entered: "✓ entered", repeat: "= in the map already", aside: "△ set aside", rejected: "✕ rejected" };

function tableOfJobs(jobs) {
  $("uploads").textContent = jobs.length ? "" : "None yet.";
  const became = (job) => (job.state === "entered" && job.revision !== null ? `, revision ${job.revision}` : "");
  table("jobs", ["Session", "Robot", "Uploaded (UTC)", "State", "Verdict", "Remarks"], jobs.map((job) => [
    String(job.id), job.robot, minute(job.created_at), `${STATES[job.state] ?? job.state}${became(job)}`, job.verdict || "–", job.reason || "–"]));
}

// Robots by the revision that they use, as they report, and where their newest sessions ended.
function tableOfRobots() {
  const rows = held.map((one) => {
    const mine = one.maps.filter((item) => item.mapId === site);
    const used = mine.find((item) => item.mapStatus === "ENABLED")?.mapVersion ?? "";
    return { ...one, used, also: mine.map((item) => item.mapVersion).filter((version) => version !== used) };
  }).filter((one) => one.used || one.also.length).sort((a, b) => Number(b.used) - Number(a.used));
  const right = rows.filter((one) => one.used === String(approved)).length;
  $("holders").textContent = !rows.length ? "No robot has reported that it holds this map." : approved ? `${right} of ${rows.length} use revision ${approved}, which is approved.` : "";
  const seen = new Map(fleet.map((one) => [one.robot, one])), silent = fleet.filter((one) => !rows.some((row) => row.robot === one.robot));
  const last = (one) => (!one ? "–" : `${one.x_m === null ? "unknown" : `${one.x_m.toFixed(1)}, ${one.y_m.toFixed(1)} m at ${moment(one.stamp_s)}`} (revision ${one.revision})`);
  const uses = (one) => (one.used ? `${one.used} ${one.used === String(approved) ? "✓ approved" : "△ another"}` : "none");
  table("robots", ["Robot", "Uses", "Also holds", "Reported (UTC)", "Last place (x, y)"], [
    ...rows.map((one) => [one.robot, uses(one), one.also.join(", ") || "–", minute(one.at), last(seen.get(one.robot))]),
    ...silent.map((one) => [one.robot || "without a name", "–", "–", "–", last(one)])]);
}

// Server-Sent Events by fetch, which can send the token.
async function follow() {
  if (follows) follows.abort();
  const { signal } = (follows = new AbortController());
  while (!signal.aborted) {
    try {
      const reader = (await get(of("events"), { signal })).body.pipeThrough(new TextDecoderStream()).getReader();
      await Promise.all([refresh(number() === head()), beside()]); // what was missed meanwhile
      say("live");
      let text = "";
      for (let part = await reader.read(); !part.done; part = await reader.read()) {
        text += part.value;
        const end = text.lastIndexOf("\n\n") + 2, lines = text.slice(0, end);
        if (lines.includes("event: revision")) await refresh(number() === head());
        if (lines.includes("event: ")) await beside();
        if (end > 1) text = text.slice(end);
      }
    } catch (error) { if (signal.aborted) return; }
    say("the server does not answer; retrying");
    await new Promise((wake) => setTimeout(wake, 3000));
  }
}

async function choose() {
  [site, tile, chosen, compares, order, revisions, fleet, kinds] = [$("site").value, null, null, false, [], [], [], []];
  $("map").classList.remove("near");
  $("why").textContent = "Choose a landmark.";
  $("word").hidden = true;
  await beside();
  await refresh(true);
  if (approved && approved < head()) compare(head(), approved); // what waits for approval
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

$("enter").addEventListener("submit", (event) => { event.preventDefault(); token = $("token").value; start(); });
$("name").addEventListener("input", search);
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
$("renames").addEventListener("click", rename);
$("site").addEventListener("change", choose);
$("before").addEventListener("input", () => {
  compares = (at("before")?.revision ?? 0) !== at("time")?.parent;
  show();
});
$("time").addEventListener("input", () => {
  picks += 1;
  show();
});
for (const [what, event] of [[window, "resize"], [matchMedia("(prefers-color-scheme: dark)"), "change"]]) what.addEventListener(event, () => { if (view) repaint(); });
handle();
if (token) start();
