"""Trains a base and variants of it under several seeds and compares them: python3 sweep.py FILE.toml DIR

FILE.toml says what to train (sweep.toml in this folder has every key). DIR holds the runs, their picture and a copy of the
program. After Ctrl-C, a kill or a failure, the same command resumes. Needs Linux, Python 3.11 and the program.
"""
import argparse
import contextlib
import ctypes
import datetime
import fcntl
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

if sys.version_info < (3, 11):
    sys.exit("sweep.py needs Python 3.11 or newer")
import tomllib

sys.dont_write_bytecode = True
import compare
import given
import program

# The keys of the file that have defaults. The others are then None.
DEFAULTS = {"seeds": [0, 1], "set": [], "variants": {}, "stop": [], "keep": [], "table": [], "window": 1_000_000}


# The most bytes of the header of a checkpoint that are read.
MOST_HEADER = 1 << 24
# What goes wrong in reading a file that something else has written or damaged.
NOT_OURS = OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError


class Sweep:
    """The trainings that a file defines, with their runs in a folder."""

    def __init__(self, file, folder, binary, runs, threads):
        self.file, self.folder, self.program = file, folder, binary
        self.__dict__.update(dict.fromkeys(given.FILE) | DEFAULTS | given.read(file))
        # `fork` is relative to the folder of the runs, `config` to the file.
        self.fork = self.fork and os.path.normpath(folder / self.fork)
        self.config = self.config and str(file.resolve().parent / self.config)
        self.settings = self.config and text_of(self.config)
        self.expect_rules()
        self.runs, self.threads = share(len(self.seeds) * (1 + len(self.variants)), runs or self.runs, threads or self.threads)
        # The steps at which trainings pause, to apply stop rules or to copy their checkpoint.
        self.pauses = {rule["at"] for rule in self.stop} | set(self.keep)
        self.runs_of = {name: [Run(self, name, seed) for seed in self.seeds] for name in ["base", *self.variants]}
        self.milestones = sorted(at for at in self.pauses | set(self.table) | {self.steps} if at <= self.steps)
        self.verdicts = {}

    def expect_rules(self):
        """Exits unless the checkpoints to fork can be read, each training has steps to make, and each stop rule is for steps of the base."""
        try:
            begun = max(steps_of(fork_of(self.fork, seed)) for seed in self.seeds)
        except compare.Damaged as error:
            sys.exit(str(error))
        if min([self.steps, *(of.get("steps", self.steps) for of in self.variants.values())]) <= begun:
            sys.exit(f"{self.file}: `steps` must be above {begun:,}, the steps of the checkpoint that is forked")
        for rule in self.stop:
            if not begun < rule["at"] <= self.steps:
                sys.exit(f"{self.file}: the base makes the steps from {begun:,} to {self.steps:,}, and this rule is for others: {rule}")

    def all_runs(self):
        return [run for runs in self.runs_of.values() for run in runs]

    def verdict(self, name, position):
        """Returns None if a variant may continue from here, why it is stopped, or "waits" while runs to compare are missing."""
        for rule in sorted(self.stop, key=lambda rule: rule["at"]):
            if name == "base" or rule["at"] > position:
                continue
            key = name, json.dumps(rule)
            if key not in self.verdicts:
                pairs = [pair for pair in zip(self.runs_of["base"], self.runs_of[name]) if not any(run.failed for run in pair)]
                if any(run.position() < rule["at"] for pair in pairs for run in pair):
                    return "waits"
                logs = [[run.log() for run in pair] for pair in pairs]
                self.verdicts[key] = compare.fails(rule, [pair for pair in logs if None not in pair], self.window)
            if self.verdicts[key]:
                return self.verdicts[key]
        return None

    def logs(self, name):
        logs = {run.seed: run.log() for run in self.runs_of[name]}
        return {seed: log for seed, log in logs.items() if log}

    def expect_columns(self, log):
        """Exits unless a run that has begun logs the metrics of all stop rules."""
        for rule in self.stop:
            if compare.column(rule["metric"]) not in log.rows[0]:
                sys.exit(f"{self.file}: metrics.csv has no column {rule['metric']}; it has {', '.join(log.rows[0])}")

    def begin(self):
        """Prepares the folder, and exits if it is in use. Returns the lock that keeps others from using it."""
        for run in self.all_runs():
            run.expect_settings()
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = (self.folder / "lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            sys.exit(f"{self.folder}: another sweep.py is at work here")
        except OSError:
            # This file system has no locks. Even so, a training refuses a folder that is in use.
            pass
        if self.program != copy_in(self.folder):
            program.copy(self.program, copy_in(self.folder))
            self.program = copy_in(self.folder)
        threads = f"{self.threads} threads" if self.threads > 1 else "one thread"
        trainings = f"{len(self.all_runs())} trainings" if len(self.all_runs()) > 1 else "one training"
        plan = f"{trainings}, {self.runs} at a time, {threads} each"
        (self.folder / "machine.txt").write_text(f"{compare.processor()}, {plan}\n")
        say(plan)
        return lock


class Run:
    """One training: a variant with one seed."""

    def __init__(self, sweep, variant, seed):
        self.sweep, self.variant, self.seed = sweep, variant, seed
        # The legend of the picture shows this name.
        self.path = sweep.folder / f"{variant}-{seed}"
        own = sweep.variants.get(variant, {})
        self.set = sweep.set + own.get("set", [])
        self.fork = fork_of(sweep.fork, seed)
        self.end = own.get("steps", sweep.steps)
        self.pauses = sorted({at for at in sweep.pauses if at < self.end} | {self.end})
        # Why it failed, and the steps of the checkpoint from which it was last resumed.
        self.failed, self.resumed = None, None

    def name(self):
        return f"{self.variant}, seed {self.seed}"

    def beside(self, kind):
        return self.path.with_name(f"{self.path.name}.{kind}")

    def checkpoints(self):
        return sorted((self.path / "checkpoints").glob("iteration-*.safetensors"))

    def fail(self, reason):
        self.failed = reason
        say(f"{self.name()} failed, {reason}")

    def log(self):
        """Returns its metrics, or None if it has made no iteration. If they are damaged, the run has failed."""
        table = self.path / "metrics.csv"
        try:
            has_rows = table.exists() and table.read_bytes().count(b"\n") > 1
            return compare.Log(table) if has_rows else None
        except (compare.Damaged, OSError) as error:
            return None if self.failed else self.fail(error)

    def newest(self):
        """Returns its newest undamaged checkpoint, from which the training resumes, or None."""
        for checkpoint in reversed(self.checkpoints()):
            with contextlib.suppress(compare.Damaged):
                progress_of(checkpoint)
                return checkpoint
        return None

    def position(self):
        """Returns the control steps that it has made."""
        return steps_of(self.newest() or self.fork)

    def pause(self):
        """Returns the steps at which it pauses next, or None at its end."""
        position = self.position()
        return next((at for at in self.pauses if at > position), None)

    def command(self):
        end = ["--threads", self.sweep.threads, "--total-steps", self.pause()]
        if self.checkpoints():
            # A run does not find the user's own scene by itself.
            scene = scene_of(self.path / "config.toml")
            again = ["--set", f"env.model={scene}"] if scene != "builtin" else []
            return [self.sweep.program, "train", "--resume", self.path, *again, *end]
        begin = ["--fork", self.fork] if self.fork else ["--seed", self.seed]
        config = ["--config", self.sweep.config] if self.sweep.config else []
        sets = [word for setting in self.set for word in ("--set", setting)]
        # At first, each training only begins. So wrong settings show before any training has run for hours.
        return [self.sweep.program, "train", *begin, *config, *sets, *end, "--run-dir", self.path, "--stop-after", "1s"]

    def keep_copy(self):
        """At a pause, copies the checkpoint if the copy is wanted and does not exist yet."""
        if not self.newest():
            return
        log, position = self.log(), self.position()
        # The steps of its iterations, which can grow longer.
        made = log.steps if log else []
        passed = [at for at in self.pauses if position == next((steps for steps in made if steps >= at), None)]
        if not passed or passed[-1] not in self.sweep.keep:
            return
        copy = self.sweep.folder / "kept" / f"{self.variant}-{self.seed}-{passed[-1]}.safetensors"
        if not copy.exists():
            copy.parent.mkdir(exist_ok=True)
            program.copy_whole(self.newest(), copy)

    def wait_until_free(self):
        """Waits until a training in this folder ends. Trainings of a killed sweep end by themselves, but not at once."""
        lock = self.path / "run.lock"
        if not lock.exists():
            return
        with lock.open() as file, contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)

    def expect_settings(self):
        """Exits unless the folder was begun with the same settings. Returns the path of their record, and the settings."""
        of = self.sweep
        settings = {"fork": self.fork and str(self.fork), "config": of.settings, "set": self.set}
        record = self.beside("json")
        if self.path.exists() and not record.exists():
            sys.exit(f"{self.path}: there is a run, but no record of its settings; choose another folder")
        if self.path.exists() and read_json(record) != settings:
            sys.exit(f"{record}: {self.name()} was begun with these settings, not with those of {of.file}; choose another folder")
        return record, settings

    def start(self):
        record, settings = self.expect_settings()
        record.write_text(json.dumps(settings, indent=1))
        self.wait_until_free()
        self.resumed = self.position() if self.checkpoints() else None
        with self.beside("log").open("ab") as log:
            return subprocess.Popen([str(word) for word in self.command()], stdout=log, stderr=log, start_new_session=True,
                                    preexec_fn=at_low_priority)

    def last_words(self):
        return "\n".join(self.beside("log").read_text(errors="replace").splitlines()[-5:])


def copy_in(folder):
    """Returns where a sweep has its copy of the program, so that no rebuild or upgrade replaces it in the middle of the sweep."""
    return folder / "program"


def share(trainings, runs, threads):
    """Returns how many trainings run at once, and the threads of each. By default all run, with equal shares of the cores:
    many trainings with few threads make more steps together than few trainings with many threads."""
    cores = len(os.sched_getaffinity(0))
    runs = max(1, min(trainings, runs or cores // (threads or 1)))
    return runs, threads or max(1, cores // runs)


def fork_of(pattern, seed):
    """Returns the checkpoint that the training with this seed forks, or None."""
    return pattern and pathlib.Path(pattern.replace("{seed}", str(seed)))


def steps_of(checkpoint):
    """Returns the control steps that a training had made when it wrote this checkpoint. Without a checkpoint, these are none."""
    return progress_of(checkpoint)["env_steps"] if checkpoint else 0


def progress_of(checkpoint):
    """Returns the progress of the training that wrote a checkpoint: at least the counts `iteration` and `env_steps`."""
    if not checkpoint.is_file():
        raise compare.Damaged(f"{checkpoint}: there is no such checkpoint")
    try:
        with checkpoint.open("rb") as file:
            header = file.read(min(int.from_bytes(file.read(8), "little"), MOST_HEADER))
        progress = json.loads(json.loads(header)["__metadata__"]["progress"])
        counts = [of[key] for of in (progress, progress.get("fork", progress)) for key in ("iteration", "env_steps")]
    except NOT_OURS as error:
        raise compare.Damaged(f"{checkpoint}: this is no checkpoint of a training run: {error!r}")
    if not all(map(given.is_whole(0), counts)):
        raise compare.Damaged(f"{checkpoint}: its progress is no progress of a training run")
    return progress


def scene_of(config):
    """Returns the scene that the settings of a run name."""
    try:
        return tomllib.loads(config.read_text())["env"].get("model", "builtin")
    except NOT_OURS as error:
        raise compare.Damaged(f"{config}: these are no settings of a training run: {error!r}")


def read_json(file):
    """Returns what a file says, or None if it is damaged."""
    with contextlib.suppress(ValueError, RecursionError):
        return json.loads(file.read_text())


def text_of(file):
    if not pathlib.Path(file).is_file():
        sys.exit(f"{file}: there is no such file")
    try:
        return pathlib.Path(file).read_text()
    except (OSError, ValueError) as error:
        sys.exit(f"{file}: {error}")


def at_low_priority():
    """Called in the process of a training: sets the lowest priority, and lets it save and end if this program is killed."""
    os.nice(19)
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)


class Stopped(Exception):
    pass


def stop(number, _):
    raise Stopped(number)


def train(sweep):
    """Trains all runs until they end or are stopped. Returns whether none failed."""
    lock = sweep.begin()
    for run in sweep.all_runs():
        # The run may have reached a pause when this program was killed.
        run.keep_copy()
    at_work = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    try:
        work(sweep, at_work)
    except Stopped as stopped:
        for child in at_work.values():
            child.terminate()
        for child in at_work.values():
            child.wait()
        say("stopped; the same command resumes")
        sys.exit(128 + stopped.args[0])
    lock.close()
    failed = [run.name() for run in sweep.all_runs() if run.failed]
    if failed:
        say(f"failed: {'; '.join(failed)}; the same command tries again")
    return not failed


def work(sweep, at_work):
    """Starts trainings, and handles the end of those in `at_work`, until no training is left to start."""
    said = set()
    while True:
        for run in [run for run, child in at_work.items() if child.poll() is not None]:
            child = at_work.pop(run)
            if child.returncode != 0:
                run.fail(f"exit code {child.returncode}, {run.beside('log')} ends with:\n{run.last_words()}")
            elif not run.checkpoints() or run.position() == run.resumed:
                run.fail(f"it made no step, {run.beside('log')} ends with:\n{run.last_words()}")
            elif log := run.log():
                sweep.expect_columns(log)
                run.keep_copy()
                say(f"{run.name()}: {run.position():,} of {run.end:,} steps")
        ready = []
        for run in sweep.all_runs():
            if run in at_work or run.failed or run.pause() is None:
                continue
            verdict = sweep.verdict(run.variant, run.position())
            if verdict is None:
                ready.append(run)
            elif verdict != "waits" and run.variant not in said:
                said.add(run.variant)
                say(f"{run.variant} is stopped: {verdict}")
        # First the runs that have not begun, then the least advanced, seed by seed. So all can be compared early.
        ready.sort(key=lambda run: (len(run.checkpoints()) > 0, run.pause(), sweep.seeds.index(run.seed)))
        for run in ready[:sweep.runs - len(at_work)]:
            try:
                run.keep_copy()
                at_work[run] = run.start()
            except (compare.Damaged, OSError) as error:
                run.fail(error)
        if not at_work and all(run.failed for run in ready):
            return
        time.sleep(0.5)


def say(text):
    print(f"{datetime.datetime.now():%H:%M:%S} {text}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--runs", type=int, metavar="N", help="trainings at a time; default: all of them, at most one for each core")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of each training; default: its share of the cores")
    parser.add_argument("--program", metavar="FILE", 
                        help="program of a new sweep; default: target/release/shadow-repose of this checkout, or that on the PATH")
    parser.add_argument("--table", action="store_true", help="print how far each training is and the tables so far, without training")
    parser.add_argument("--publish", type=pathlib.Path, metavar="FOLDER",
                        help="write thinned metrics, settings and results to FOLDER, without training")
    args = parser.parse_args()
    if any(number is not None and number < 1 for number in (args.runs, args.threads)):
        parser.error("--runs and --threads must be at least 1")
    folder = args.folder.resolve()
    binary = copy_in(folder) if copy_in(folder).exists() else program.find(args.program)
    sweep = Sweep(args.file, folder, binary, args.runs, args.threads)
    only_looks = args.table or args.publish is not None
    if only_looks:
        for run in sweep.all_runs():
            run.expect_settings()
            if args.table:
                print(f"{run.name()}: {run.position():,} of {run.end:,} steps")
    whole = only_looks or train(sweep)
    print(compare.tables(sweep))
    runs = [run.path for run in sweep.all_runs() if run.log()]
    if args.publish and not runs:
        sys.exit("there is nothing to publish yet")
    if args.publish:
        compare.publish(sweep, args.publish)
    elif runs:
        compare.draw(sweep.program, runs, sweep.folder / "picture.svg")
    return 0 if whole else 1


if __name__ == "__main__":
    # The name of a folder may be no text.
    sys.stdout.reconfigure(errors="backslashreplace")
    try:
        sys.exit(main())
    except OSError as error:
        sys.exit(str(error))
