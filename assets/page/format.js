// The data of the page: packed numbers, vectors and quaternions (w x y z), the recorded rows, and the poses of the bodies.

/** Returns the bytes that base64 text stands for. (The page's security policy forbids to fetch a data address.) */
const fromBase64 = (text) => Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));

function toBase64(bytes) {
  let letters = "";
  for (let i = 0; i < bytes.length; i += 8192) letters += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(letters);
}

async function passThrough(bytes, filter) {
  return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(filter)).arrayBuffer());
}

const unpack = (text) => passThrough(fromBase64(text), new DecompressionStream("gzip"));
const pack = async (bytes) => toBase64(await passThrough(bytes, new CompressionStream("gzip")));

/** Reads a table of 16-bit integers: column by column, differences from row to row, all low bytes before all high bytes. */
function readTable(bytes, begin, rows, columns) {
  const count = rows * columns, table = new Int16Array(count);
  for (let source = 0; source < count; source++) {
    const row = source % rows, place = row * columns + (source - row) / rows;
    const difference = bytes[begin + source] + 256 * bytes[begin + count + source];
    table[place] = (row ? table[place - columns] : 0) + difference; // Int16Array wraps around
  }
  return table;
}

/** Writes what `readTable` reads. */
function writeTable(table, rows, columns) {
  const count = rows * columns, bytes = new Uint8Array(2 * count);
  for (let target = 0; target < count; target++) {
    const row = target % rows, place = row * columns + (target - row) / rows;
    const difference = table[place] - (row ? table[place - columns] : 0);
    bytes[target] = difference;
    bytes[count + target] = difference >> 8;
  }
  return bytes;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** a + factor b */
const plus = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
function unit(vector) {
  const length = Math.hypot(...vector);
  return length > 0 ? vector.map((x) => x / length) : vector;
}
function rotate([w, ...axis], vector) {
  const side = cross(axis, vector).map((x) => 2 * x);
  return plus(plus(vector, side, w), cross(axis, side));
}
function compose([w, ...u], [s, ...v]) {
  const mixed = plus(plus(cross(u, v), v, w), u, s);
  return [w * s - dot(u, v), ...mixed];
}

/** The pose of a body relative to its parent's, after the joints have moved. */
function moveJoints(joints, numbers, pos, quat) {
  for (const joint of joints) {
    const by = numbers[joint.at] - joint.rest;
    if (joint.type === "slide") {
      pos = plus(pos, rotate(quat, joint.axis), by);
      continue;
    }
    const anchor = plus(pos, rotate(quat, joint.pos)), sine = Math.sin(by / 2);
    const ball = joint.type === "ball";
    const own = ball ? unit([...numbers.subarray(joint.at, joint.at + 4)]) : [Math.cos(by / 2), ...joint.axis.map((x) => sine * x)];
    quat = compose(quat, own);
    pos = plus(anchor, rotate(quat, joint.pos), -1);
  }
  return [pos, quat];
}

/** Calculates the bodies' poses from a row's numbers (MuJoCo's mj_kinematics); `poses` gets x y z 0 w x y z of each. */
function kinematics(bodies, numbers, poses) {
  bodies.forEach((body, index) => {
    let { pos, quat } = body;
    const placed = body.mocap ?? (body.joints[0]?.type === "free" ? body.joints[0].at : -1);
    if (placed >= 0) {
      pos = [...numbers.subarray(placed, placed + 3)];
      quat = [...numbers.subarray(placed + 3, placed + 7)];
    } else if (index > 0) {
      const [x, y, z, , ...turned] = poses.subarray(8 * body.parent, 8 * body.parent + 8);
      [pos, quat] = moveJoints(body.joints, numbers, plus([x, y, z], rotate(turned, pos)), compose(turned, quat));
    }
    poses.set([...pos, 0, ...unit(quat)], 8 * index);
  });
}

/** Returns where in a row the quaternions begin. */
function quaternionPlaces(bodies) {
  const offset = { free: 3, ball: 0 };
  const places = bodies.flatMap((body) => body.joints.filter(({ type }) => type in offset).map(({ type, at }) => at + offset[type]));
  return [...places, ...bodies.filter((body) => body.mocap >= 0).map((body) => body.mocap + 3)];
}

/** The rows of a recording: for each hand, numbers that give the poses, then scalars. Live, rows come at the end and go at the front. */
class Recording {
  constructor(meta) {
    this.meta = meta;
    this.hands = meta.hands;
    this.width = meta.numbers + meta.scalars.length;
    this.place = Object.fromEntries(meta.scalars.map((name, i) => [name, meta.numbers + i]));
    this.period = meta.dt * meta.every; // seconds from row to row
    this.rows = [];
    /** For each hand the beginnings of its episodes, oldest first: {row, policy, seed, ...}; `row` is negative if it is gone. */
    this.episodes = Array.from({ length: meta.hands }, () => []);
    /** What is known of the episode that each hand begins next. */
    this.coming = this.episodes.map(() => ({}));
  }

  static async read(meta, text) {
    const recording = new Recording(meta), columns = recording.width * meta.hands;
    if (!meta.rows) return recording;
    const table = readTable(await unpack(text), 0, meta.rows, columns);
    const values = Float32Array.from(table, (value, i) => value * meta.scale[i % columns]);
    for (let row = 0; row < meta.rows; row++) {
      for (const { hand, ...about } of (meta.episodes ?? []).filter((episode) => episode.row === row)) recording.announce(hand, about);
      recording.add(values.subarray(row * columns, (row + 1) * columns));
    }
    return recording;
  }

  get last() { return Math.max(0, this.rows.length - 1); }
  has(name) { return name in this.place; }
  value(row, hand, name) { return this.rows[row][hand * this.width + this.place[name]]; }
  announce(hand, about) { this.coming[hand] = { ...about, fresh: true }; }

  add(row) {
    const index = this.rows.push(row) - 1;
    this.episodes.forEach((list, hand) => {
      const { fresh, ...about } = this.coming[hand];
      if (!fresh && index && this.value(index, hand, "step") > this.value(index - 1, hand, "step")) return;
      list.push({ ...about, row: index });
      this.coming[hand] = about;
    });
  }

  /** Forgets the oldest rows. */
  drop(count) {
    this.rows.splice(0, count);
    for (const list of this.episodes) {
      for (const episode of list) episode.row -= count;
      while (list.length > 1 && list[1].row <= 0) list.shift();
    }
  }

  episode(hand, row) { return this.episodes[hand].findLast((episode) => episode.row <= row) ?? { row: 0 }; }

  /** Whether a row goes on from the one before: not the first of an episode, and nothing missing between. */
  joined(hand, row) {
    if (row < 1 || row > this.last || this.episode(hand, row).row === row) return false;
    return this.value(row, hand, "step") - this.value(row - 1, hand, "step") === this.meta.every;
  }

  /** Writes the numbers at a time between two rows, hand after hand, to `mixed`. */
  mix(time, quaternions, mixed) {
    const row = Math.min(this.last, Math.floor(time)), before = this.rows[row], after = this.rows[row + 1];
    mixed.set(before);
    for (let hand = 0; hand < this.hands; hand++) {
      if (!this.joined(hand, row + 1)) continue;
      const begin = hand * this.width, part = time - row;
      for (let i = begin; i < begin + this.meta.numbers; i++) mixed[i] += part * (after[i] - before[i]);
      for (const place of quaternions) mixQuaternion(before, after, part, begin + place, mixed);
    }
  }

  /** Returns the rows as text and the entries of `meta` that belong to them. */
  async write() {
    const { rows, hands, width } = this, columns = hands * width, counters = ["step", "held", "goals"].map((name) => this.place[name]);
    if (rows.some((row) => row.some((value, i) => counters.includes(i % width) && value > 32767))) {
      throw new Error("an episode has more than 32767 steps");
    }
    const scale = Array.from({ length: columns }, (_, i) => {
      if (counters.includes(i % width)) return 1;
      return rows.reduce((most, row) => Math.max(most, Math.abs(row[i])), 1e-9) / 32767;
    });
    const table = new Int16Array(rows.length * columns);
    rows.forEach((row, r) => row.forEach((value, i) => { table[r * columns + i] = Math.round(value / scale[i]); }));
    const episodes = this.episodes.flatMap((list, hand) => list.map((episode) => ({ ...episode, hand, row: Math.max(0, episode.row) })));
    return { text: await pack(writeTable(table, rows.length, columns)), entries: { rows: rows.length, scale, episodes } };
  }
}

/** q and -q are the same turn: takes the short way, and none where the goal changes at once. */
function mixQuaternion(before, after, part, place, mixed) {
  let same = 0;
  for (let i = place; i < place + 4; i++) same += before[i] * after[i];
  const weight = Math.abs(same) < .85 ? 0 : Math.sign(same) * part, rest = weight === 0 ? 1 : 1 - part;
  for (let i = place; i < place + 4; i++) mixed[i] = rest * before[i] + weight * after[i];
}
