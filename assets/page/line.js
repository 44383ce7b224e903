// The time line: the rotation error over time, goals, episodes, and a cursor. All but the cursor is drawn once.

const MARGIN = { left: 36, right: 12, top: 15, bottom: 17 };
const LINE_FONT = "11px system-ui, sans-serif";

class TimeLine {
  constructor(canvas, recording, seek) {
    Object.assign(this, { canvas, recording, hand: 0 });
    canvas.classList.toggle("bare", !recording.has("error"));
    const follow = (event) => seek((event.offsetX - MARGIN.left) / this.inner.width * recording.last);
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); follow(event); });
    canvas.addEventListener("pointermove", (event) => { if (event.buttons & 1) follow(event); });
  }

  get inner() {
    const { clientWidth, clientHeight } = this.canvas;
    return { width: Math.max(1, clientWidth - MARGIN.left - MARGIN.right), height: clientHeight - MARGIN.top - MARGIN.bottom };
  }

  across(row) { return MARGIN.left + this.inner.width * row / (this.recording.last || 1); }
  /** The root of the error, so that the last degrees are seen. */
  down(error) { return MARGIN.top + this.inner.height * (1 - Math.sqrt(Math.min(1, Math.abs(error) / Math.PI))); }

  resize() {
    this.ratio = Math.min(2, devicePixelRatio || 1);
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * this.ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * this.ratio));
    [this.stale, this.due] = [true, 0];
  }

  draw(time) {
    const { canvas, ratio, recording } = this, context = canvas.getContext("2d"), inks = inksOf(canvas);
    if (this.stale && performance.now() >= this.due) {
      this.drawn = this.drawAll(inks);
      this.stale = false;
      this.due = performance.now() + 250; // live, four times a second are enough
    }
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (this.drawn) context.drawImage(this.drawn, 0, 0);
    context.fillStyle = inks.text;
    context.fillRect((this.across(time) - 1) * ratio, 0, 2 * ratio, (canvas.clientHeight - MARGIN.bottom + 3) * ratio);
    const say = (name, rows, unit = "") => canvas.setAttribute(`aria-value${name}`, (rows * recording.period).toFixed(2) + unit);
    say("max", recording.last);
    say("now", time);
    say("text", time, " seconds");
  }

  drawAll(inks) {
    const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
    [canvas.width, canvas.height] = [this.canvas.width, this.canvas.height];
    context.scale(this.ratio, this.ratio);
    context.textBaseline = "middle";
    context.font = LINE_FONT;
    this.drawSeconds(context, inks);
    if (this.recording.has("error") && this.recording.rows.length) {
      this.drawTolerance(context, inks);
      this.drawAxis(context, inks);
      this.drawError(context, inks);
    }
    this.drawEpisodes(context, inks);
    if (this.recording.has("goals")) this.drawGoals(context, inks);
    return canvas;
  }

  drawSeconds(context, { quiet }) {
    const { last, period } = this.recording, seconds = last * period, { clientWidth, clientHeight } = this.canvas;
    const every = [.1, .2, .5, 1, 2, 5, 10, 20, 60].find((step) => seconds / step <= clientWidth / 64) ?? 120;
    context.fillStyle = quiet;
    context.textAlign = "center";
    for (let i = 0; i * every <= seconds + 1e-6; i++) {
      const x = Math.min(clientWidth - 14, this.across(i * every / period));
      context.fillText(`${Number((i * every).toFixed(1))} s`, x, clientHeight - 7);
    }
  }

  drawAxis(context, { edge, quiet }) {
    context.textAlign = "right";
    for (const degrees of [0, 10, 45, 180]) {
      const y = this.down(degrees * Math.PI / 180);
      context.fillStyle = edge;
      context.fillRect(MARGIN.left, y - .5, this.inner.width, 1);
      context.fillStyle = quiet;
      context.fillText(`${degrees}\u00b0`, MARGIN.left - 5, y);
    }
  }

  drawTolerance(context, { good }) {
    const { recording, hand } = this, { rows, meta } = recording;
    context.fillStyle = good;
    context.globalAlpha = .26;
    for (let row = 1, begin = -1; row <= rows.length; row++) {
      const within = row < rows.length && recording.joined(hand, row) && recording.value(row, hand, "error") <= meta.tolerance;
      if (within && begin < 0) begin = row;
      if (within || begin < 0) continue;
      const left = this.across(begin);
      context.fillRect(left, MARGIN.top, Math.max(1, this.across(row - 1) - left), this.inner.height);
      begin = -1;
    }
    context.globalAlpha = 1;
  }

  drawError(context, { curve }) {
    const { recording, hand } = this;
    context.strokeStyle = curve;
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    context.beginPath();
    recording.rows.forEach((_, row) => {
      const place = [this.across(row), this.down(recording.value(row, hand, "error"))];
      if (recording.joined(hand, row)) context.lineTo(...place);
      else context.moveTo(...place);
    });
    context.stroke();
  }

  drawGoals(context, { good }) {
    const { recording, hand } = this;
    let free = 0; // no number on top of another
    context.fillStyle = good;
    context.font = `bold ${LINE_FONT}`;
    context.textAlign = "center";
    for (let row = 1; row < recording.rows.length; row++) {
      const goals = recording.value(row, hand, "goals"), x = this.across(row);
      if (!recording.joined(hand, row) || goals <= recording.value(row - 1, hand, "goals")) continue;
      context.fillRect(x - .75, MARGIN.top - 2, 1.5, this.inner.height + 2);
      const name = String(Math.round(goals)), half = context.measureText(name).width / 2;
      if (x - half < free) continue;
      context.fillText(name, x, 7);
      free = x + half + 3;
    }
  }

  drawEpisodes(context, { text }) {
    context.fillStyle = text;
    for (const { row } of this.recording.episodes[this.hand]) {
      if (row > 0) context.fillRect(this.across(row) - 1, MARGIN.top - 4, 2, this.inner.height + 8);
    }
  }
}

/** The colours of the style sheet: light or dark. */
function inksOf(element) {
  const style = getComputedStyle(element), names = ["text", "quiet", "edge", "curve", "good", "floor"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}
