// The words and bars over the picture.

const byId = (id) => document.getElementById(id);
/** Shows a sentence; without one, `notice.lasting`, which is true as long as the page is open, and a link if that has one. */
function notice(text) {
  const shown = text || notice.lasting || "";
  byId("notice").hidden = !shown;
  byId("notice").replaceChildren(shown, ...(text || !notice.link ? [] : [" ", notice.link]));
}

function make(kind, name, text = "") {
  const element = document.createElement(kind);
  element.className = name;
  element.textContent = text;
  return element;
}

const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;

/** Replaces the text only where it changes: a screen reader and the layout need not look at it again. */
function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Goals, held, error; policy, seed and settings of the episode. */
class Facts {
  constructor(recording) {
    this.recording = recording;
    const { meta } = recording;
    byId("title").textContent = meta.title;
    byId("what").hidden = !recording.has("goals");
    byId("what").textContent = "The hand turns the lower object until it matches the goal above it.";
    document.title = meta.live ? `${meta.title} (live)` : meta.title;
    this.about = "";
  }

  draw(row, hand) {
    const { recording } = this, { meta } = recording, lines = [];
    const value = (name) => recording.value(row, hand, name);
    if (recording.has("goals")) lines.push(`${plural(Math.round(value("goals")), "goal")} reached`);
    if (recording.has("held") && meta.hold > 1) lines.push(`held for ${Math.max(0, Math.round(value("held")))} of ${meta.hold} steps`);
    if (recording.has("error")) {
      const error = value("error");
      lines.push(`${(error * 180 / Math.PI).toFixed(1)}\u00b0 from the goal (${error.toFixed(2)} rad)`);
    }
    put(byId("state"), lines.join("\n"));
    this.drawAbout(recording.episode(hand, row));
  }

  drawAbout(episode) {
    const { meta } = this.recording, settings = Object.entries(meta.settings ?? {});
    const { policy, seed, end } = { policy: meta.policy, seed: meta.seed, ...episode };
    const known = [["policy", policy], ["seed", seed], ["end of the episode", end], ["program", meta.program], ...settings];
    const facts = known.filter(([, fact]) => fact != null);
    const all = JSON.stringify(facts);
    if (all === this.about) return;
    this.about = all;
    const [summary, list] = byId("about").children;
    const parts = [policy == null || policy === meta.title ? "" : `policy: ${policy}`, seed == null ? "" : `seed ${seed}`];
    parts.push(settings.length ? plural(settings.length, "changed setting") : "default settings");
    const words = parts.filter(Boolean).join(", ");
    summary.textContent = words[0].toUpperCase() + words.slice(1);
    list.replaceChildren(...facts.flatMap(([name, fact]) => [make("dt", "", name), make("dd", "", String(fact))]));
  }
}

const short = (value) => value.toFixed(Math.abs(value) < 10 ? 2 : Math.abs(value) < 100 ? 1 : 0).replace(/^-(0\.?0*)$/, "$1");

/** A bar for each term of the reward, to the left if negative; the lengths are roots, so that small terms are seen. */
class Rewards {
  constructor(recording) {
    this.recording = recording;
    this.bars = recording.meta.terms.map((term) => ({ term, bar: make("b", ""), value: make("span", ""), sum: make("span", "sum") }));
    const box = byId("rewards");
    box.hidden = !this.bars.length;
    box.append(make("span", "head begin", "reward"), make("i", "head"), make("span", "head", "now"), make("span", "head end", "in total"));
    box.children[1].style.background = "none";
    for (const { term, bar, value, sum } of this.bars) {
      const track = make("i", "");
      track.append(bar);
      box.append(make("div", "", term), track, value, sum);
    }
    this.measure();
  }

  /** The longest bar is for what only 2 % of all values exceed: a rare bonus would make the others invisible. */
  measure() {
    const { rows } = this.recording, stride = Math.ceil(rows.length / 4000), sizes = [];
    for (let row = 0; row < rows.length; row += stride) {
      for (const { term } of this.bars) sizes.push(Math.abs(this.recording.value(row, 0, term)));
    }
    const some = sizes.filter((size) => size > 0).sort((a, b) => a - b);
    this.most = some[Math.floor(.98 * (some.length - 1))] || 1;
  }

  draw(row, hand) {
    const { recording } = this, from = Math.max(0, recording.episode(hand, row).row);
    const whole = recording.value(from, hand, "step") <= recording.meta.every; // else the episode's first rows are gone
    for (const { term, bar, value, sum } of this.bars) {
      const amount = recording.value(row, hand, term), length = 50 * Math.sqrt(Math.min(1, Math.abs(amount) / this.most));
      bar.className = amount < 0 ? "minus" : "";
      bar.style.left = `${amount < 0 ? 50 - length : 50}%`;
      bar.style.width = `${length}%`;
      let total = 0;
      for (let i = from; i <= row; i++) total += recording.value(i, hand, term);
      put(value, short(amount));
      put(sum, whole ? short(total) : "");
    }
  }
}

/** The lists of episodes and hands, and the frames around tiles. */
class Lists {
  constructor(recording, seek, choose) {
    Object.assign(this, { recording, shown: "" });
    byId("episode").onchange = () => seek(Number(byId("episode").value));
    byId("hand").onchange = () => choose(Number(byId("hand").value));
    byId("hands").hidden = byId("tiles").hidden = recording.hands < 2;
    byId("stage").classList.toggle("many", recording.hands > 1);
    for (let hand = 0; hand < recording.hands; hand++) {
      byId("hand").add(new Option(String(hand + 1), hand));
      byId("tiles").append(make("span", ""));
    }
  }

  layOut() {
    const { clientWidth, clientHeight } = byId("picture"), tiles = tilesOf(this.recording.hands, clientWidth, clientHeight);
    const [, , width, height] = tiles[0], style = byId("tiles").style, columns = tiles.filter(([, top]) => top === 0).length;
    style.gridTemplateColumns = `repeat(${columns}, ${width}px)`;
    style.gridAutoRows = `${height}px`;
  }

  /** Describes an episode: "3: 12 goals, 10.0 s". */
  describe(list, index, hand) {
    const { recording } = this, end = (list[index + 1]?.row ?? recording.rows.length) - 1;
    const words = recording.has("goals") ? [plural(Math.round(recording.value(end, hand, "goals")), "goal")] : [];
    words.push(`${(recording.value(end, hand, "step") * recording.meta.dt).toFixed(1)} s`);
    const { policy } = list[index], { meta } = recording;
    return `${index + 1}: ${words.join(", ")}${policy && policy !== meta.policy ? `, ${policy}` : ""}`;
  }

  draw(row, hand) {
    const { recording } = this, list = recording.episodes[hand], key = `${hand} ${list.map((episode) => episode.row)}`;
    byId("episodes").hidden = list.length < 2 || recording.meta.live;
    if (key !== this.shown && !recording.meta.live) {
      byId("episode").replaceChildren(...list.map((episode, i) => new Option(this.describe(list, i, hand), Math.max(0, episode.row))));
      this.shown = key;
    }
    byId("episode").value = Math.max(0, recording.episode(hand, row).row);
    byId("hand").value = hand;
    if (recording.hands < 2) return;
    [...byId("tiles").children].forEach((tile, i) => {
      tile.className = i === hand ? "chosen" : "";
      put(tile, recording.has("goals") ? plural(Math.round(recording.value(row, i, "goals")), "goal") : "");
    });
  }
}
