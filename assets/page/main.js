// The page: time, keys, and what is drawn when.

const SPEEDS = [.1, .25, .5, 1, 2, 4];
const PAUSE = 300; // milliseconds after which a picture that does not move is drawn in full
const DELAY = .12; // seconds that a live picture is behind, so that uneven arrival is not seen

/** What the page's address asks for: #t=3.2 a moment, #picture=full, simple or flat a kind of picture. */
const asked = (name) => new RegExp(`[#&]${name}=([\\w.]+)`).exec(location.hash)?.[1];
const askedMoment = () => parseFloat(asked("t")); // s, or NaN

/** Makes the best picture that this browser can, and another one after the graphics driver was reset. */
class Screen {
  constructor(scene, meshes, hands, restored) {
    Object.assign(this, { scene, meshes, hands, canvas: byId("picture"), kind: asked("picture") });
    this.fixed = Boolean(this.kind);
    this.kind ??= isSoftware() ? "simple" : "full";
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.picture = null;
      notice("The graphics driver was reset. The page waits for it.");
    });
    this.canvas.addEventListener("webglcontextrestored", () => {
      notice("");
      this.begin();
      restored();
    });
    this.begin();
  }

  begin() {
    const { canvas, scene, meshes, hands, kind } = this;
    let reason = "This browser offers no WebGL 2, so the picture is a simple one. In Chrome, turn on hardware acceleration, "
      + "or start it with --enable-unsafe-swiftshader.";
    this.picture = null;
    if (kind === "flat") {
      reason = "The address of this page asks for the simple picture.";
    } else {
      try {
        this.picture = CardPicture.on(canvas, scene, meshes, hands, kind === "simple");
      } catch (error) {
        reason = `WebGL 2 does not work here, so the picture is a simple one: ${error.message}`;
      }
    }
    if (!this.picture) this.fallBack(reason);
    [this.coarse, this.full, this.fine] = [this.picture, null, false];
    if (this.kind === "simple" && !this.fixed) this.offerFull();
  }

  /** Says that the picture is a simple one while something moves, and links to a full one. */
  offerFull() {
    notice.link = make("a", "", "Draw it always in full");
    notice.link.href = "#picture=full";
    notice.link.onclick = () => setTimeout(() => location.reload());
    notice.lasting = "This browser draws without a graphics card, so the picture is a simple one while something moves.";
    notice("");
  }

  /** Changes to the full picture where nothing moves, or back. Returns whether that is another one than before. */
  refine(fine) {
    if (this.kind !== "simple" || this.fixed || this.fine === fine || !this.picture) return false;
    const { scene, meshes, hands } = this;
    this.fine = fine;
    if (fine) this.full ??= new CardPicture(this.coarse.gl, scene, meshes, hands, false);
    this.picture = fine ? this.full : this.coarse;
    return true;
  }

  /** A canvas that was asked for one kind of picture gives no other: it is replaced. */
  fallBack(reason) {
    const fresh = this.canvas.cloneNode();
    this.canvas.replaceWith(fresh);
    this.canvas = fresh;
    this.kind = "flat";
    this.picture = new FlatPicture(fresh, this.scene, this.meshes, this.hands);
    this.replaced?.(fresh);
    notice(notice.lasting = reason);
  }

  resize() {
    const fine = Math.min(2, devicePixelRatio || 1) * (this.picture?.pixels ?? 1), { canvas } = this;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * fine));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * fine));
  }
}

class Player {
  constructor(recording, scene, meshes, original) {
    const { meta } = recording;
    Object.assign(this, { recording, scene, original, live: meta.live, following: meta.live });
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches && !meta.live;
    Object.assign(this, { now: 0, hand: 0, playing: !still, dirty: true });
    this.quaternions = quaternionPlaces(scene.bodies);
    this.mixed = new Float32Array(recording.hands * recording.width);
    this.poses = new Float32Array(8 * scene.bodies.length * recording.hands);
    if (scene.camera.fit) this.fit();
    this.orbit = new Orbit(scene.camera, () => { this.dirty = true; }, (x, y) => this.pick(x, y));
    this.screen = new Screen(scene, meshes, recording.hands, () => this.resize());
    this.screen.replaced = (canvas) => this.orbit.listenTo(canvas);
    this.orbit.listenTo(this.screen.canvas);
    this.line = new TimeLine(byId("line"), recording, (row) => this.seek(row));
    this.facts = new Facts(recording);
    this.rewards = new Rewards(recording);
    this.lists = new Lists(recording, (row) => this.seek(row), (hand) => this.choose(hand));
    const moment = askedMoment();
    if (moment >= 0) [this.now, this.playing] = [Math.min(recording.last, moment / recording.period), false];
    this.listen();
    this.resize();
    if (meta.live) this.follow();
    window.stats = { frames: 0, busy: 0, player: this };
    this.last = performance.now();
    requestAnimationFrame((time) => this.frame(time));
  }

  /** The camera that shows all of the first picture. */
  fit() {
    const { recording, scene, poses } = this, rest = Float32Array.from(scene.start);
    kinematics(scene.bodies, recording.rows[0] ?? rest, poses);
    fitCamera(scene, poses);
  }

  follow() {
    const { sliders = [], object } = this.recording.meta;
    makeSliders(sliders, Boolean(object));
    if (object) this.orbit.touch = this.touch = new Touch(this, object);
    byId("save").hidden = false;
    byId("save").onclick = () => {
      if (!this.recording.rows.length) return notice("There is nothing to save yet.");
      saveFile(this.original, this.recording).catch((error) => notice(`The file could not be made: ${error.message}.`));
    };
    this.feed = new Feed(this.recording, (dropped) => {
      this.now = Math.max(0, this.now - dropped);
      this.line.stale = this.dirty = true;
    });
    this.feed.began = (hand) => { if (this.touch?.pointer?.hand === hand) this.touch.drop(); };
  }

  listen() {
    SPEEDS.forEach((speed) => byId("speed").add(new Option(`${speed} \u00d7`, speed, speed === 1, speed === 1)));
    byId("play").onclick = () => this.toggle();
    byId("back").onclick = () => this.step(-1);
    byId("on").onclick = () => this.step(1);
    byId("home").onclick = () => this.orbit.reset();
    byId("live").onclick = () => { this.playing = this.following = this.dirty = true; };
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("hashchange", () => { if (askedMoment() >= 0) this.seek(askedMoment() / this.recording.period, true); });
    new ResizeObserver(() => this.resize()).observe(byId("stage"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.resize());
  }

  key(event) {
    const { key, target } = event, speed = byId("speed");
    if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT)$/.test(target.tagName)) return;
    if (key === " " && /^(BUTTON|SUMMARY)$/.test(target.tagName)) return; // presses it
    const faster = (by) => { speed.selectedIndex = Math.min(SPEEDS.length - 1, Math.max(0, speed.selectedIndex + by)); };
    const steps = event.shiftKey ? 25 : 1;
    const act = {
      " ": () => this.toggle(), ArrowLeft: () => this.step(-steps), ArrowRight: () => this.step(steps),
      ArrowUp: () => faster(1), ArrowDown: () => faster(-1), r: () => this.orbit.reset(),
      Home: () => this.seek(this.recording.episode(this.hand, Math.floor(this.now)).row), End: () => this.seek(this.recording.last),
      "+": () => this.orbit.zoom(.9), "=": () => this.orbit.zoom(.9), "-": () => this.orbit.zoom(1 / .9),
    }[key.length === 1 ? key.toLowerCase() : key];
    if (!act) return;
    event.preventDefault();
    act();
  }

  toggle() {
    this.playing = !this.playing;
    this.following &&= this.playing;
    this.dirty = true;
  }

  step(by) { this.seek((by < 0 ? Math.ceil(this.now) : Math.floor(this.now)) + by, true); }

  seek(row, pause = false) {
    this.now = Math.min(this.recording.last, Math.max(0, row));
    this.following = false;
    this.playing &&= !pause;
    this.dirty = true;
  }

  choose(hand) {
    this.hand = this.line.hand = hand;
    this.line.stale = this.dirty = true;
    this.line.due = 0;
  }

  pick(x, y) {
    const { clientWidth, clientHeight } = this.screen.canvas;
    const within = ([left, top, width, height]) => x >= left && x < left + width && y >= top && y < top + height;
    const found = tilesOf(this.recording.hands, clientWidth, clientHeight).findIndex(within);
    if (found >= 0) this.choose(found);
  }

  /** The sizes are set just before the next picture is drawn: a canvas is empty after it. */
  resize() {
    this.sized = false;
    this.dirty = true;
  }

  layOut() {
    this.screen.resize();
    this.line.resize();
    this.lists.layOut();
    this.sized = true;
    this.tone = [1, 3, 5].map((i) => parseInt(inksOf(document.documentElement).floor.slice(i, i + 2), 16) / 255);
  }

  /** Moves the time on by seconds of the clock. */
  advance(seconds) {
    const { last, period } = this.recording, before = this.now;
    if (this.following) {
      const behind = last - DELAY / period - this.now;
      this.now = Math.abs(behind) > 1 / period ? last - DELAY / period : this.now + seconds / period + .05 * behind;
      this.now = Math.min(last, Math.max(0, this.now));
    } else {
      this.now += seconds / period * Number(byId("speed").value);
      if (this.now >= last) this.now = this.live || !last ? last : 0;
    }
    this.dirty ||= this.now !== before;
  }

  frame(time) {
    requestAnimationFrame((next) => this.frame(next));
    const seconds = Math.min(.25, Math.max(0, time - this.last) / 1000);
    this.last = time;
    if (!this.recording.rows.length) return;
    if (this.playing) this.advance(seconds);
    if (!this.screen.picture) return;
    const rests = !this.dirty && !this.playing && time - this.moved > PAUSE;
    if (this.dirty) this.moved = time;
    if ((this.dirty || rests) && this.screen.refine(rests)) [this.sized, this.dirty] = [false, true];
    if (!this.dirty) return;
    this.adapt(seconds);
    if (!this.sized) this.layOut();
    this.dirty = false;
    const begin = performance.now();
    this.draw();
    window.stats.frames++;
    window.stats.busy += performance.now() - begin;
  }

  /** Draws less carefully after some slow frames. */
  adapt(seconds) {
    this.slow = seconds > .06 ? (this.slow ?? 0) + 1 : 0;
    if (this.slow < 8 || this.screen.fixed || !this.playing) return;
    this.slow = 0;
    this.screen.picture.easier();
    this.sized = false;
  }

  draw() {
    const { recording, scene, hand, now } = this, bodies = 8 * scene.bodies.length, row = Math.min(recording.last, Math.round(now));
    recording.mix(now, this.quaternions, this.mixed);
    for (let i = 0; i < recording.hands; i++) {
      const numbers = this.mixed.subarray(i * recording.width, i * recording.width + recording.meta.numbers);
      kinematics(scene.bodies, numbers, this.poses.subarray(i * bodies, (i + 1) * bodies));
    }
    this.screen.picture.draw(this.poses, this.orbit.sight, this.tone);
    this.drawGoal();
    this.touch?.draw();
    if (this.live && this.line.stale) this.rewards.measure();
    this.line.draw(now);
    this.facts.draw(row, hand);
    this.rewards.draw(row, hand);
    this.lists.draw(row, hand);
    this.drawClock(row, hand);
  }

  /** Puts the word "goal" over the goal, which is of glass. */
  drawGoal() {
    const label = byId("goal"), { recording, screen, poses, scene } = this;
    const glass = scene.geoms.find(({ body, rgba }) => rgba[3] < 1 && scene.bodies[body].mocap >= 0);
    label.hidden = !glass || !recording.has("goals") || recording.hands > 1;
    if (label.hidden) return;
    const [x, y, z] = poses.subarray(8 * glass.body), { clientWidth, clientHeight } = screen.canvas;
    const project = projectionOf(this.orbit.sight, [0, 0, clientWidth, clientHeight]);
    const [left, above, away] = project([x, y, z + Math.hypot(...glass.size)]);
    label.hidden = away <= 0;
    [label.style.left, label.style.top] = [`${left}px`, `${above}px`];
  }

  drawClock(row, hand) {
    const { recording } = this, step = Math.round(recording.value(row, hand, "step"));
    put(byId("clock"), `${(step * recording.meta.dt).toFixed(2)} s, step ${step}`);
    put(byId("play"), this.playing ? "Pause" : "Play");
    byId("live").hidden = !this.live || this.following;
    byId("speed").disabled = this.following;
  }
}

async function begin() {
  const text = (id) => byId(id).textContent, meta = JSON.parse(text("meta"));
  if (!meta.live && !meta.rows) throw new Error("it has no rows");
  const original = meta.live ? document.documentElement.cloneNode(true) : null; // for files; nothing has changed it yet
  if (meta.format !== 1) throw new Error(`it has format ${meta.format}, and this page reads format 1`);
  const scene = JSON.parse(new TextDecoder().decode(await unpack(text("scene"))));
  const meshes = scene.meshes.length ? readMeshes(scene.meshes, await unpack(text("meshes"))) : [];
  new Player(await Recording.read(meta, text("rows")), scene, meshes, original);
}

begin().catch((error) => {
  notice(`This page cannot be shown: ${error.message}. It needs Chrome 97, Firefox 113, Safari 16.4 or newer.`);
});
