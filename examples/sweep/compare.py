"""Compares the runs of a sweep seed by seed: turning, goals and drops, at equal steps and at equal time."""
import csv
import datetime
import math
import pathlib
import platform
import shutil
import statistics
import subprocess
import sys

THIN = pathlib.Path(__file__).resolve().with_name("thin.py")
# The metrics in tables, with their decimal digits.
METRICS = {"turned": 3, "eval/goals": 2, "eval/drop_rate": 3}
# The number of iterations whose times are replaced by their median, so that interruptions of a training do not count.
TIMED = 50


class Damaged(Exception):
    """A file of a run is not what a training run writes."""


class Log:
    """The metrics of a run that has made an iteration. Cells that are empty are NaN."""

    def __init__(self, table):
        try:
            # The last line may be half written.
            lines = table.read_text().rpartition("\n")[0].splitlines()
            self.rows = [{name: float(cell or math.nan) for name, cell in row.items()} for row in csv.DictReader(lines)]
            self.steps = [int(row["env_steps"]) for row in self.rows]
            seconds = [row["time/collect_s"] + row["time/update_s"] for row in self.rows]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, csv.Error) as error:
            raise Damaged(f"{table}: this is no table of a training run: {error!r}")
        if not self.rows:
            raise Damaged(f"{table}: it has no rows")
        self.seconds, spent = [], 0.0
        for first in range(0, len(seconds), TIMED):
            part = seconds[first:first + TIMED]
            for _ in part:
                spent += statistics.median(part)
                self.seconds.append(spent)

    def value(self, metric, at, window):
        """Returns the mean over the `window` steps up to `at`, or the latest evaluation. NaN if the run has not reached `at` yet."""
        if self.steps[-1] < at:
            return math.nan
        end = next(i for i, steps in enumerate(self.steps) if steps >= at) + 1
        rows = zip(self.steps[:end], self.rows)
        cells = [(steps, row.get(column(metric), math.nan)) for steps, row in rows]
        known = [(steps, value) for steps, value in cells if not math.isnan(value)]
        if metric.startswith("eval/"):
            return known[-1][1] if known else math.nan
        found = [value for steps, value in known if steps > self.steps[end - 1] - window]
        return statistics.fmean(found) if found else math.nan

    def seconds_at(self, steps):
        return next((spent for made, spent in zip(self.steps, self.seconds) if made >= steps), math.nan)

    def steps_after(self, seconds):
        return next((made for made, spent in zip(self.steps, self.seconds) if spent >= seconds), math.inf)


def column(metric):
    return "training/turned" if metric == "turned" else metric


def fails(rule, pairs, window):
    """Returns why a rule stops a variant, or None: its metric is below (or above) that fraction of the base's in all seeds.

    `pairs` holds the logs of the base and of the variant for each seed.
    """
    values = [[log.value(rule["metric"], rule["at"], window) for log in pair] for pair in pairs]
    # There is no ratio to a value that is not above zero.
    ratios = [ours / theirs if theirs > 0 else math.nan for theirs, ours in values]
    if not ratios:
        return None
    below = "below" in rule and all(ratio < rule["below"] for ratio in ratios)
    above = "above" in rule and all(ratio > rule["above"] for ratio in ratios)
    if not (below or above):
        return None
    found = ", ".join(f"{ratio:.2f}" for ratio in ratios)
    limit = f"below {rule['below']}" if below else f"above {rule['above']}"
    return f"{rule['metric']} at {rule['at']:,} steps is {found} times the base's, {limit} in all seeds"


def spread(values, digits):
    return f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""


def cell(pairs, digits, is_base):
    """Formats the mean over the seeds. For a variant, adds the mean difference from the base, its deviation and its signs."""
    pairs = [pair for pair in pairs if not any(map(math.isnan, pair))]
    if not pairs:
        return "-"
    mean = f"{statistics.fmean(ours for _, ours in pairs):.{digits}f}"
    if is_base:
        return mean + spread([ours for _, ours in pairs], digits)
    apart = [ours - theirs for theirs, ours in pairs]
    up = sum(difference > 0 for difference in apart)
    return f"{mean} ({statistics.fmean(apart):+.{digits}f}{spread(apart, digits)}, up in {up} of {len(apart)})"


def tables(sweep):
    """Returns Markdown: for each milestone that the base has reached, one table at equal steps and one at equal time."""
    logs = {name: sweep.logs(name) for name in sweep.runs_of}
    text = ""
    for at in milestones(sweep, logs):
        base = {seed: log for seed, log in logs["base"].items() if log.steps[-1] >= at}
        if not base:
            continue
        minutes = statistics.fmean(log.seconds_at(at) for log in base.values()) / 60
        equal = [(f"at {at:,} steps", lambda log, seed: at)]
        if len(logs) > 1:
            time = lambda log, seed: log.steps_after(base[seed].seconds_at(at))
            equal.append((f"after the time that the base with the same seed took for them, {minutes:,.1f} minutes on average", time))
        for title, where in equal:
            text += f"\n{title}:\n\n| | {' | '.join(METRICS)} | steps |\n|---|{'---|' * (len(METRICS) + 1)}\n"
            for name, of in logs.items():
                shared = {seed: where(of[seed], seed) for seed in base if seed in of}
                cells = []
                for metric, digits in METRICS.items():
                    value = lambda log, steps: log.value(metric, steps, sweep.window)
                    pairs = [(value(base[seed], at), value(of[seed], steps)) for seed, steps in shared.items()]
                    cells.append(cell(pairs, digits, name == "base"))
                made = [steps for seed, steps in shared.items() if steps <= of[seed].steps[-1]]
                steps = f"{statistics.fmean(made):,.0f}" if made else "-"
                text += f"| {name} | {' | '.join(cells)} | {steps} |\n"
    for name, runs in sweep.runs_of.items():
        verdict = sweep.verdict(name, max(run.position() for run in runs))
        text += f"\n{name} is stopped: {verdict}\n" if verdict not in (None, "waits") else ""
    note = "turned: rad per hundred training steps, mean over the last {:,} steps; eval: the latest evaluation until then.\n" \
           "Means over the seeds; for the base ± standard deviation; for a variant, in parentheses, the mean difference\n" \
           "from the base with the same seed ± its standard deviation."
    return note.format(sweep.window) + "\n" + text if text else "the base has not made an iteration yet"


def milestones(sweep, logs):
    """Returns the steps to compare at. Before the base reaches a milestone, these are the steps that all begun runs have made."""
    made = {name: [log.steps[-1] for log in of.values()] for name, of in logs.items()}
    if made["base"] and max(made["base"]) < sweep.milestones[0]:
        return [min(steps for of in made.values() for steps in of)]
    return sweep.milestones


def draw(program, runs, picture, more=()):
    metrics = [word for column in ("training/turned", "eval/goals", "eval/drop_rate") for word in ("--metric", column)]
    subprocess.run([program, "plot", *runs, "--out", picture, *metrics, *more], check=False)


def publish(sweep, folder):
    """Writes the thinned metrics of all runs, the settings, the comparison tables and their picture."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for run in sweep.all_runs():
        if run.log():
            found.append(folder / f"{run.variant}-{run.seed}")
            subprocess.run([sys.executable, THIN, run.path, found[-1] / "metrics.csv"], check=True)
    shutil.copyfile(sweep.file, folder / "sweep.toml")
    if sweep.config:
        shutil.copyfile(sweep.config, folder / pathlib.Path(sweep.config).name)
    draw(sweep.program, found, folder / "picture.svg", ["--smooth", "1"])
    version = (sweep.runs_of["base"][0].path / "version.txt").read_text(errors="replace").replace("\n", ", ").strip(", ")
    machine = f"{datetime.date.today()}, {(sweep.folder / 'machine.txt').read_text().strip()}"
    facts = f"{machine}.\nProgram: {version}."
    (folder / "README.md").write_text(f"# {folder.name}\n\n{facts}\n\n{tables(sweep)}\n![curves](picture.svg)\n")


def processor():
    lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines() if pathlib.Path("/proc/cpuinfo").exists() else []
    facts = {line.split(":")[0].strip(): line.split(":")[1].strip() for line in lines if ":" in line}
    family = f", family {facts['cpu family']} model {facts['model']}" if "cpu family" in facts else ""
    return facts.get("model name", platform.machine()) + family
