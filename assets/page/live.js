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
    on("episode", ({ data }) => { const { hand, ...about } = JSON.parse(data); this.recording.announce(hand, about); });
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

function showControls(values) {
  [...byId("sliders").querySelectorAll("input")].forEach((input, i) => {
    if (input === document.activeElement && performance.now() - (input.touched ?? -1e9) < 1000) return;
    input.value = values[i];
    input.nextElementSibling.textContent = Number(values[i]).toFixed(2);
  });
}

/** A slider for each actuator; what is moved goes to the program, at most one request at a time. */
function makeSliders(sliders) {
  const box = byId("sliders"), moved = new Map();
  let busy = false;
  const send = async () => {
    if (busy || !moved.size) return;
    busy = true;
    const body = JSON.stringify([...moved]);
    moved.clear();
    try {
      const answer = await fetch(`controls${location.search}`, { method: "POST", headers: { "Content-Type": "application/json" }, body });
      if (!answer.ok) notice(`The program refused the new value: ${answer.status} ${answer.statusText}.`);
    } catch {
      notice("The new value did not reach the program.");
    }
    busy = false;
    send();
  };
  sliders.forEach(({ name, low, high, value }, i) => {
    const label = make("label", "", name), input = make("input", ""), shown = make("output", "", value.toFixed(2));
    Object.assign(input, { type: "range", min: low, max: high, step: "any", value });
    input.oninput = () => {
      input.touched = performance.now();
      shown.textContent = Number(input.value).toFixed(2);
      moved.set(i, Number(input.value));
      send();
    };
    label.append(input, shown);
    box.append(label);
  });
  box.hidden = !sliders.length;
  if (sliders.length) byId("rewards").hidden = true;
}

/** Makes a file of the page as it came (`original`, a copy of the document) and the kept rows. */
async function saveFile(original, recording) {
  const page = original.cloneNode(true), { text, entries } = await recording.write(), { meta } = recording;
  const { live, key, sliders, ...lasting } = meta;
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
