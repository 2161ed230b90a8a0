// Shows the pictures that come, and says what the hands do. Pictures: u32 length, head (JSON), JPEG.
"use strict";

const $ = (id) => document.getElementById(id);
const canvas = $("picture"), context = canvas.getContext("2d", { alpha: false });
const FIRST_WAIT = 0.5, LONGEST_WAIT = 8; // s before the page tries to connect again

let socket = null, wait = FIRST_WAIT, timer = 0;
let saying = {}, scheduled = false; // what the next message says
let duration = 0, scrubbing = false, opened = false;
const times = []; // when recent pictures were shown, ms
window.cap4d = { shown: 0, latency: null, fps: 0 }; // for whoever measures

// The line --------------------------------------------------------------------------------------

function connect() {
  clearTimeout(timer);
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  const mine = new WebSocket(`${scheme}//${location.host}/socket${location.search}`);
  socket = mine;
  mine.binaryType = "arraybuffer";
  mine.onopen = () => { wait = FIRST_WAIT; sayLook(); };
  mine.onmessage = ({ data }) => { typeof data === "string" ? tell(JSON.parse(data)) : show(mine, data); };
  mine.onclose = ({ code }) => { if (socket === mine) away(code); };
}

function away(code) {
  socket = null;
  document.body.classList.add("away");
  if (document.hidden) return;
  $("notice").textContent = code === 1013 ? "As many people as can are watching already."
    : code === 1008 ? "The viewer hung up on this page. Reload it to try again."
    : opened ? "The viewer is away. Waiting for it to come back." : "No answer from the viewer. Trying again.";
  if (code === 1008) return;
  timer = setTimeout(connect, wait * 1000);
  wait = Math.min(2 * wait, LONGEST_WAIT);
}

// One message per drawn frame, however fast a mouse reports.
function say(words) {
  for (const [key, value] of Object.entries(words)) {
    if (key === "turn" || key === "pan") saying[key] = (saying[key] || [0, 0]).map((x, i) => x + value[i]);
    else if (key === "zoom") saying.zoom = (saying.zoom || 0) + value;
    else if (key === "expr") saying.expr = { ...saying.expr, ...value };
    else saying[key] = value;
  }
  if (!scheduled) { scheduled = true; requestAnimationFrame(flush); }
}

function flush() {
  scheduled = false;
  const words = saying;
  saying = {};
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(words));
}

// Pictures --------------------------------------------------------------------------------------

async function show(from, data) {
  const length = new DataView(data).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const image = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
  if (canvas.width !== image.width || canvas.height !== image.height) {
    canvas.width = image.width;
    canvas.height = image.height;
  }
  context.drawImage(image, 0, 0);
  image.close();
  if (from !== socket) return;
  socket.send(JSON.stringify({ ack: head.n })); // the echo by which the viewer measures the latency
  count(head);
}

function count(head) {
  const now = performance.now();
  times.push(now);
  while (times[0] < now - 2000) times.shift();
  const fps = times.length > 1 ? (times.length - 1) / (times[times.length - 1] - times[0]) * 1000 : 0;
  Object.assign(window.cap4d, { shown: window.cap4d.shown + 1, latency: head.latency, fps, head });
  if (!opened || document.body.classList.contains("away")) {
    opened = true;
    document.body.classList.remove("away");
    canvas.classList.add("shown");
    $("notice").textContent = "";
  }
  if (!scrubbing) fill($("at"), head.at);
  $("live").textContent = { waiting: "waiting for frames", playing: "live", holding: "live, no frames", easing: "live, no frames" }[head.stream] || "";
}

setInterval(() => {
  const { fps, latency, head } = window.cap4d;
  if (!head) return;
  const still = !times.length || times[times.length - 1] < performance.now() - 1000;
  const late = latency === null ? "" : `${latency < 10 ? latency.toFixed(1) : Math.round(latency)} ms`;
  $("figures").textContent = [still ? "" : `${Math.round(fps)} fps`, late].filter(Boolean).join("  ·  ");
  $("figures").title = `from the begin of drawing to the echo that it is shown\n${head.drawn} ms of it to draw, ` +
    `${head.size.join("×")}, quantiser ${head.quantiser}`;
}, 500);

// What the viewer tells -------------------------------------------------------------------------

function tell({ hello, state }) {
  if (hello) {
    document.title = $("title").textContent = hello.title;
    $("title").title = `${hello.rig}, ${hello.gaussians.toLocaleString("en")} Gaussians, ${hello.deformer}, ${hello.backend}`;
    duration = hello.duration;
    $("at").max = duration;
    $("at").hidden = hello.live;
    $("live").hidden = !hello.live;
    build(hello.expressions);
  }
  if (state) {
    document.body.classList.toggle("paused", state.paused);
    $("play").title = state.paused ? "Play (space)" : "Pause (space)";
    $("play").setAttribute("aria-label", state.paused ? "Play" : "Pause");
    $("reset").disabled = !Object.keys(state.held).length;
    for (const row of $("sliders").querySelectorAll("label")) {
      const input = row.querySelector("input"), held = row.dataset.name in state.held;
      row.classList.toggle("held", held);
      if (input !== document.activeElement || !held) fill(input, held ? state.held[row.dataset.name] : 0);
      row.querySelector("output").textContent = Number(input.value).toFixed(2);
    }
  }
}

function build(groups) {
  $("sliders").replaceChildren(...Object.entries(groups).map(([group, members]) => {
    const section = document.createElement("section"), title = document.createElement("h2");
    title.textContent = group;
    section.append(title, ...members.map(slider));
    return section;
  }));
}

function slider([name, low, high]) {
  const row = document.createElement("label"), text = document.createElement("span");
  const output = document.createElement("output"), input = document.createElement("input");
  Object.assign(input, { type: "range", min: low, max: high, step: (high - low) / 200 || 0.01, value: 0 });
  text.textContent = readable(name);
  input.addEventListener("input", () => { fill(input, input.value); say({ expr: { [name]: Number(input.value) } }); });
  row.addEventListener("dblclick", () => { input.blur(); say({ expr: { [name]: null } }); });
  row.dataset.name = name;
  row.append(text, output, input);
  fill(input, 0);
  return row;
}

// "mouthSmile_L" -> "mouth smile left"
function readable(name) {
  return name.replace(/_L$/, "Left").replace(/_R$/, "Right").replace(/([a-z])([A-Z])/g, "$1 $2").toLowerCase();
}

function fill(input, value) {
  input.value = value;
  const span = input.max - input.min;
  input.style.setProperty("--fill", `${span ? (input.value - input.min) / span * 100 : 0}%`);
}

// Hands -----------------------------------------------------------------------------------------

const pointers = new Map(); // id -> its last place

canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, event);
});
canvas.addEventListener("pointermove", (event) => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  pointers.set(event.pointerId, event);
  const right = event.clientX - last.clientX, down = event.clientY - last.clientY;
  const { clientWidth: width, clientHeight: height } = canvas, shorter = Math.min(width, height);
  if (pointers.size === 2) pinch(event, last, right / 2 / shorter, down / 2 / shorter);
  else if (event.shiftKey || event.buttons & 6) say({ pan: [right / shorter, down / shorter] });
  else say({ turn: [right / height, down / height] });
});
for (const kind of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
}

function pinch(event, last, right, down) {
  const [other] = [...pointers.values()].filter((p) => p.pointerId !== event.pointerId);
  const span = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY) || 1;
  say({ pan: [right, down], zoom: Math.log(span(event) / span(last)) / Math.log(1 / 0.9) });
}

canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1);
  say({ zoom: Math.max(-5, Math.min(5, -pixels / 100)) });
}, { passive: false });
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("dblclick", () => say({ home: true }));

const toggle = () => say({ play: document.body.classList.contains("paused") });
const open = () => {
  const hidden = !$("expressions").toggleAttribute("hidden");
  $("faces").setAttribute("aria-expanded", hidden);
  if (hidden) $("search").focus();
};
$("play").addEventListener("click", toggle);
$("home").addEventListener("click", () => say({ home: true }));
$("faces").addEventListener("click", open);
$("reset").addEventListener("click", () => say({ reset: true }));
$("at").addEventListener("input", () => { scrubbing = true; fill($("at"), $("at").value); say({ seek: Number($("at").value) }); });
$("at").addEventListener("change", () => { scrubbing = false; });
$("search").addEventListener("input", () => {
  const words = $("search").value.toLowerCase().split(/\s+/);
  for (const section of $("sliders").children) {
    const rows = [...section.querySelectorAll("label")];
    for (const row of rows) {
      const name = `${row.dataset.name} ${readable(row.dataset.name)}`.toLowerCase();
      row.hidden = !words.every((word) => name.includes(word));
    }
    section.hidden = rows.every((row) => row.hidden);
  }
});
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Escape" && !$("expressions").hidden) { open(); canvas.focus(); return; }
  if (event.target.matches("input[type=search]")) return;
  if (event.key === " " && !event.target.matches("button")) { event.preventDefault(); toggle(); }
  if (event.key === "r") say({ home: true });
  if (event.key === "e") { event.preventDefault(); open(); }
});

// The page's own shape and colour ---------------------------------------------------------------

function sayLook() {
  const ratio = devicePixelRatio || 1;
  const [r, g, b] = getComputedStyle(document.body).backgroundColor.match(/[\d.]+/g).map(Number);
  say({
    size: [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio))),
    background: [r / 255, g / 255, b / 255],
  });
}

addEventListener("resize", sayLook);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", sayLook);
document.addEventListener("visibilitychange", () => { // a hidden page shows nothing, so it asks for nothing
  if (document.hidden) { if (socket) socket.close(); } else if (!socket) connect();
});

connect();
