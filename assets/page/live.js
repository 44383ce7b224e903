// The live page: rows that arrive as Server-Sent Events, sliders that are sent back, and the rows kept as a file.

const KEPT_SECONDS = 30;
const MOST_BEHIND = 2000; // milliseconds
const SILENCE = 5000;
const LASTING = 10000;
const LOST = "There is no connection to the program. It has ended, or it has too many viewers. The page tries again.";

class Feed {
  /** Calls `arrived` with the number of rows that were dropped, after each row. */
  constructor(recording, arrived) {
    Object.assign(this, { recording, arrived, source: null, heard: 0, best: Infinity, punctual: Infinity, wait: 1000, retry: 0 });
    document.addEventListener("visibilitychange", () => (document.hidden ? this.close() : this.open()));
    setInterval(() => { if (this.source && performance.now() - this.heard > SILENCE) this.again(); }, 1000);
    this.open();
  }

  open() {
    clearTimeout(this.retry);
    if (this.source || document.hidden) return;
    const source = this.source = new EventSource(`events${location.search}`);
    const begun = performance.now();
    [this.heard, this.best] = [begun, Infinity];
    const on = (name, act) => source.addEventListener(name, (event) => {
      if (source !== this.source) return;
      this.heard = performance.now();
      act(event);
    });
    on("hello", ({ data }) => this.greet(JSON.parse(data)));
    on("episode", ({ data }) => { const { hand, ...about } = JSON.parse(data); this.recording.announce(hand, about); this.began?.(hand); });
    on("controls", ({ data }) => showControls(JSON.parse(data)));
    on("beat", () => {});
    on("message", ({ data, lastEventId }) => this.take(data, Number(lastEventId)));
    source.onerror = () => {
      if (source !== this.source) return;
      if (performance.now() - begun < LASTING) return this.again(LOST);
      this.close(); // Behind a proxy, no connection lasts.
      this.open();
    };
  }

  close() {
    clearTimeout(this.retry);
    this.source?.close();
    this.source = null;
  }

  /** Connects anew; a new connection begins with the newest rows. */
  again(reason = "The connection is slow or silent. The page connects again.") {
    this.close();
    notice(reason);
    this.retry = setTimeout(() => this.open(), this.wait);
    this.wait = Math.min(5000, 1.5 * this.wait);
  }

  /** The first event of a connection, and the first one after some that were missed. What comes does not go on from what is there. */
  greet({ key, episodes, controls }) {
    if (key !== this.recording.meta.key) return location.reload(); // another program, with another scene
    episodes.forEach((about, hand) => this.recording.announce(hand, about));
    if (controls) showControls(controls);
    [this.wait, this.punctual] = [1000, performance.now()];
    notice("");
  }

  /** `sent` is the program's clock when it made the row: the way of a row that takes longer and longer means a slow connection. */
  take(text, sent) {
    const { recording } = this, row = new Float32Array(fromBase64(text).buffer);
    const now = performance.now(), way = now - sent;
    this.best = Math.min(this.best, way);
    if (way - this.best < MOST_BEHIND) this.punctual = now;
    if (now - this.punctual > 1000) return this.again(); // not if only the page itself was busy
    if (row.length !== recording.hands * recording.width) return;
    recording.add(row);
    const most = Math.round(KEPT_SECONDS / recording.period), surplus = recording.rows.length - most;
    const dropped = surplus > most / 20 ? surplus : 0; // not one by one
    if (dropped) recording.drop(dropped);
    this.arrived(dropped);
  }
}

/** Sends something to the program. One request is under way at a time; what `next` returns after it goes next, if it returns anything. */
class Sender {
  constructor(next) { Object.assign(this, { next, busy: false }); }

  async send() {
    const said = this.busy ? undefined : this.next();
    if (said === undefined) return;
    this.busy = true;
    const body = JSON.stringify(said);
    try {
      const answer = await fetch(`controls${location.search}`, { method: "POST", headers: { "Content-Type": "application/json" }, body });
      if (!answer.ok) notice(`The program refused this: ${answer.status} ${answer.statusText}.`);
    } catch {
      notice("This did not reach the program.");
    }
    this.busy = false;
    this.send();
  }
}

const BUTTONS = { pause: "Pause or go on", step: "One step", goal: "Next goal", episode: "New episode", reset: "As the task has it" };
const AGAIN = 100; // milliseconds after which a push is asked for again
const STRETCH = .05; // metres of a pull that is as strong as twice the object's weight
const STRONGEST = 4; // times the object's weight

/** Pushes the object where it is dragged, with a force that is drawn as a line. */
class Touch {
  constructor(player, { at, mass }) {
    const body = player.scene.bodies.findIndex(({ joints }) => joints.some((joint) => joint.type === "free" && joint.at === at));
    Object.assign(this, { player, body, weight: 9.81 * mass, pointer: null, newtons: 0 });
    this.sender = new Sender(() => { const { said } = this; this.said = undefined; return said; });
    setInterval(() => this.pull(), AGAIN);
  }

  /** Where the object of a hand is on the screen, and what moves a point there by pixels. */
  seen(hand) {
    const { player, body } = this, { scene, recording, orbit, poses } = player, { clientWidth, clientHeight } = player.screen.canvas;
    const tile = tilesOf(recording.hands, clientWidth, clientHeight)[hand], { eye, forward, tangent } = orbit.sight;
    const at = [...poses.subarray(8 * (hand * scene.bodies.length + body)).subarray(0, 3)];
    const [x, y, away] = projectionOf(orbit.sight, tile)(at), view = lookAlong(eye, forward, [0, 0, 1]);
    const [, , width, height] = tile, pixel = away * tangent * Math.max(1, .9 * height / width) / (height / 2);
    const axis = (k) => [view[k], view[k + 4], view[k + 8]].map((part) => part * pixel);
    return { at, x, y, away, right: axis(0), up: axis(1) };
  }

  /** Whether a pointer that comes down there takes hold of an object. */
  takes({ offsetX, offsetY, pointerId, button }) {
    if (button || this.body < 0 || !this.player.following || this.pointer) return false;
    const near = 22;
    for (let hand = 0; hand < this.player.recording.hands; hand++) {
      const { x, y, away, right } = this.seen(hand);
      if (away > 0 && Math.hypot(offsetX - x, offsetY - y) < Math.max(near, .03 / Math.hypot(...right))) {
        this.pointer = { id: pointerId, hand, x: offsetX, y: offsetY };
        return true;
      }
    }
    return false;
  }

  moves({ offsetX, offsetY, pointerId }) {
    if (this.pointer?.id !== pointerId) return false;
    Object.assign(this.pointer, { x: offsetX, y: offsetY });
    this.pull();
    return true;
  }

  ends({ pointerId }) {
    if (this.pointer?.id !== pointerId) return false;
    this.push([0, 0, 0]);
    this.drop();
    return true;
  }

  /** Lets the object go. */
  drop() {
    this.pointer = null;
    this.draw();
  }

  pull() {
    if (!this.pointer) return;
    const { x, y, right, up } = this.seen(this.pointer.hand), [across, down] = [this.pointer.x - x, this.pointer.y - y];
    const way = [0, 1, 2].map((k) => right[k] * across - up[k] * down), length = Math.hypot(...way) || 1;
    const force = this.weight * Math.min(STRONGEST, 2 * length / STRETCH);
    this.push(way.map((part) => part / length * force));
    this.draw();
  }

  push(force) {
    this.said = { push: [this.pointer.hand, force] };
    this.sender.send();
    this.newtons = Math.hypot(...force);
  }

  draw() {
    const line = byId("force"), { pointer } = this;
    line.hidden = !pointer;
    if (!pointer) return;
    const { x, y } = this.seen(pointer.hand), [across, down] = [pointer.x - x, pointer.y - y];
    line.textContent = `${this.newtons.toFixed(2)} N`;
    Object.assign(line.style, {
      left: `${x}px`, top: `${y}px`, width: `${Math.hypot(across, down)}px`, transform: `rotate(${Math.atan2(down, across)}rad)`,
    });
  }
}

function showControls(values) {
  [...byId("sliders").querySelectorAll("input")].forEach((input, i) => {
    if (input === document.activeElement && performance.now() - (input.touched ?? -1e9) < 1000) return;
    input.value = values[i];
    show(input, values[i]);
  });
}

/** Shows the value of a slider, in bold if it is not what the task has. */
function show(input, value) {
  input.nextElementSibling.textContent = Number(value).toFixed(2);
  input.parentElement.classList.toggle("changed", Math.abs(value - input.start) > 1e-9);
}

/** The sliders, and buttons if the page may also touch the world. What is moved or pressed goes to the program. */
function makeSliders(sliders, touches) {
  const box = byId("sliders"), moved = new Map(), pressed = [];
  const sender = new Sender(() => {
    if (pressed.length) return pressed.shift();
    const said = moved.size ? [...moved] : undefined;
    moved.clear();
    return said;
  });
  if (touches) {
    const row = make("p", "");
    Object.entries(BUTTONS).forEach(([order, text]) => {
      const button = make("button", "", text);
      button.onclick = () => { pressed.push(order); sender.send(); };
      row.append(button);
    });
    box.append(row, make("p", "", "Drag the object to push it. Values that differ from the task are bold."));
  }
  sliders.forEach(({ name, low, high, step, value }, i) => {
    const label = make("label", "", name), input = make("input", ""), shown = make("output", "");
    Object.assign(input, { type: "range", min: low, max: high, step: step || "any", value, start: value });
    input.oninput = () => {
      input.touched = performance.now();
      show(input, Number(input.value));
      moved.set(i, Number(input.value));
      sender.send();
    };
    label.append(input, shown);
    box.append(label);
    show(input, value);
  });
  const open = (shown) => { [box.hidden, byId("rewards").hidden] = [!shown, shown]; };
  byId("touch").hidden = !touches;
  byId("touch").onclick = () => open(box.hidden);
  open(sliders.length > 0 && !touches);
}

/** Makes a file of the page as it came (`original`, a copy of the document) and the kept rows. */
async function saveFile(original, recording) {
  const page = original.cloneNode(true), { text, entries } = await recording.write(), { meta } = recording;
  const { live, key, sliders, object, ...lasting } = meta;
  const part = (id) => page.querySelector(`#${id}`);
  part("meta").textContent = JSON.stringify({ ...lasting, ...entries, live: false }).replaceAll("<", "\\u003c");
  part("rows").textContent = text;
  const policy = page.querySelector("meta[http-equiv]");
  policy.content = policy.content.replace("connect-src 'self'", "connect-src 'none'");
  const file = new Blob([`<!doctype html>\n${page.outerHTML}\n`], { type: "text/html" });
  const link = make("a", "");
  link.href = URL.createObjectURL(file);
  link.download = `${meta.title.replace(/[^\w.-]+/g, "-").replace(/^-|-$/g, "") || "replay"}.html`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
