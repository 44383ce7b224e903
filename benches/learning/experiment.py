"""Trains a base and variants of it under several seeds and compares them: python experiment.py FILE.toml DIR

FILE.toml defines what to train (see README.md in this folder); the runs go into DIR. After a stop or a kill, the same command
resumes. Needs only Python 3.11 and the program.
"""
import argparse
import ctypes
import datetime
import fcntl
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
import tomllib

sys.dont_write_bytecode = True
import compare

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]
DEFAULTS = {"seeds": [0, 1], "threads": 1, "runs": 2, "keep": [], "table": [], "stop": [], "set": [], "variants": {},
            "fork": None, "config": None, "window": 1_000_000}


class Experiment:
    """The experiment that a file defines, with its runs in a folder."""

    def __init__(self, file, folder, program):
        self.file, self.folder = file, folder
        # A copy, so that a rebuild does not replace the program in the middle of the experiment.
        self.program = folder / "program"
        self.copied_from = program
        given = tomllib.loads(file.read_text())
        unknown = set(given) - set(DEFAULTS) - {"steps"}
        if unknown or "steps" not in given:
            sys.exit(f"{file}: " + (f"unknown: {', '.join(sorted(unknown))}" if unknown else "`steps` is missing"))
        self.__dict__.update(DEFAULTS | given)
        if "base" in self.variants:
            sys.exit(f"{file}: `base` is what the variants are compared with and cannot be one of them")
        for name, of in self.variants.items():
            if set(of) - {"set", "steps"}:
                sys.exit(f"{file}: a variant may only have `set` and `steps`: {name}")
        for rule in self.stop:
            if not {"at", "metric"} < set(rule) <= {"at", "metric", "below", "above"}:
                sys.exit(f"{file}: a stop rule needs `at`, `metric`, and `below` or `above`: {rule}")
        if self.fork and "{seed}" not in self.fork and len(self.seeds) > 1:
            sys.exit(f"{file}: `fork` must contain {{seed}}, or all seeds would be the same training from one checkpoint")
        # `fork` is relative to the folder of the runs, `config` to the experiment file.
        self.fork = self.fork and str(folder / self.fork)
        self.config = self.config and str(file.resolve().parent / self.config)
        for seed in self.seeds if self.fork else []:
            if not pathlib.Path(self.fork.format(seed=seed)).is_file():
                sys.exit(f"{self.fork.format(seed=seed)}: there is no such checkpoint")
        begun = max((steps_of(pathlib.Path(self.fork.format(seed=seed))) for seed in self.seeds), default=0) if self.fork else 0
        if early := [rule for rule in self.stop if rule["at"] <= begun]:
            sys.exit(f"{file}: the trainings begin at {begun:,} steps; this stop rule is not after that: {early[0]}")
        # The steps at which trainings pause, to apply stop rules or to copy their checkpoint.
        self.pauses = {rule["at"] for rule in self.stop} | set(self.keep)
        self.runs_of = {name: [Run(self, name, seed) for seed in self.seeds] for name in ["base", *self.variants]}
        self.milestones = sorted(at for at in self.pauses | set(self.table) | {self.steps} if at <= self.steps)

    def all_runs(self):
        return [run for runs in self.runs_of.values() for run in runs]

    def verdict(self, name, position):
        """Returns None if a variant may continue from here, why it is stopped, or "waits" while runs to compare are missing."""
        for rule in sorted(self.stop, key=lambda rule: rule["at"]):
            if name == "base" or rule["at"] > position:
                continue
            judged = self.runs_of["base"] + self.runs_of[name]
            if any(run.position() < rule["at"] for run in judged):
                return "waits"
            reason = compare.fails(rule, *(self.logs(of) for of in ("base", name)), self.window)
            if reason:
                return reason
        return None

    def logs(self, name):
        return {run.seed: compare.Log(run.path) for run in self.runs_of[name] if (run.path / "metrics.csv").exists()}

    def drawer(self):
        """Returns the program that draws the picture: the experiment's copy, or the user's if there is no copy yet."""
        return self.program if self.program.exists() else self.copied_from

    def copy_program(self):
        if not self.program.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            shutil.copy2(self.copied_from, self.program)


class Run:
    """One training: a variant with one seed."""

    def __init__(self, experiment, variant, seed):
        self.experiment, self.variant, self.seed = experiment, variant, seed
        # The legend of the picture shows this name.
        self.path = experiment.folder / f"{variant}-{seed}"
        own = experiment.variants.get(variant, {})
        self.set = experiment.set + own.get("set", [])
        self.fork = experiment.fork and experiment.fork.format(seed=seed)
        end = own.get("steps", experiment.steps)
        self.pauses = sorted({at for at in experiment.pauses if at < end} | {end})
        self.failed = None

    def name(self):
        return f"{self.variant}, seed {self.seed}"

    def beside(self, kind):
        return self.path.with_name(f"{self.path.name}.{kind}")

    def checkpoints(self):
        return sorted((self.path / "checkpoints").glob("iteration-*.safetensors"))

    def position(self):
        """Returns the control steps of the newest checkpoint, from which the training resumes."""
        found = self.checkpoints()
        if found:
            return steps_of(found[-1])
        return steps_of(pathlib.Path(self.fork)) if self.fork else 0

    def steps_per_iteration(self):
        progress = progress_of(self.checkpoints()[-1])
        begun = progress.get("fork", {"iteration": 0, "env_steps": 0})
        return (progress["env_steps"] - begun["env_steps"]) // max(progress["iteration"] - begun["iteration"], 1)

    def pause(self):
        """Returns the steps at which it pauses next, or None at its end."""
        position = self.position()
        return next((at for at in self.pauses if at > position), None)

    def command(self):
        of, pause = self.experiment, str(self.pause())
        if self.checkpoints():
            return [of.program, "train", "--resume", self.path, "--threads", str(of.threads), "--total-steps", pause]
        begin = ["--fork", self.fork] if self.fork else ["--seed", str(self.seed)]
        config = ["--config", of.config] if of.config else []
        sets = [word for setting in self.set for word in ("--set", setting)]
        end = ["--threads", str(of.threads), "--total-steps", pause, "--run-dir", self.path]
        return [of.program, "train", *begin, *config, *sets, *end]

    def keep_copy(self):
        """At a pause, copies the checkpoint if the copy is wanted and does not exist yet."""
        if not self.checkpoints():
            return
        position = self.position()
        passed = [at for at in self.pauses if at <= position < at + self.steps_per_iteration()]
        if not passed or passed[-1] not in self.experiment.keep:
            return
        copy = self.experiment.folder / "kept" / f"{self.variant}-{self.seed}-{passed[-1]}.safetensors"
        if not copy.exists():
            copy.parent.mkdir(exist_ok=True)
            partial = copy.with_suffix(".partial")
            partial.write_bytes(self.checkpoints()[-1].read_bytes())
            partial.rename(copy)

    def wait_until_free(self):
        """Waits for a training in this folder to end: those of a killed experiment do so by themselves, but not at once."""
        lock = self.path / "run.lock"
        if not lock.exists():
            return
        with lock.open() as file:
            fcntl.flock(file, fcntl.LOCK_EX)

    def expect_settings(self):
        """Exits unless the folder was begun with the same settings; returns the path of their record, and the settings."""
        of = self.experiment
        config = pathlib.Path(of.config).read_text() if of.config else None
        settings = {"fork": self.fork, "config": config, "set": self.set}
        record = self.beside("json")
        if not record.exists() and self.path.exists():
            sys.exit(f"{self.path}: there is a run, but no record of its settings; choose another folder")
        if record.exists() and json.loads(record.read_text()) != settings:
            sys.exit(f"{record}: {self.name()} was begun with these settings, not with those of {of.file}; choose another folder")
        return record, settings

    def start(self):
        record, settings = self.expect_settings()
        record.parent.mkdir(parents=True, exist_ok=True)
        record.write_text(json.dumps(settings, indent=1))
        self.wait_until_free()
        if self.path.exists() and not self.checkpoints():
            # It was killed before it had saved anything.
            subprocess.run(["rm", "-r", self.path], check=True)
        with self.beside("log").open("ab") as log:
            return subprocess.Popen([str(word) for word in self.command()], stdout=log, stderr=log, start_new_session=True,
                                    preexec_fn=at_low_priority)

    def last_words(self):
        return "\n".join(self.beside("log").read_text(errors="replace").splitlines()[-5:])


def steps_of(checkpoint):
    """Returns the control steps that a training had made when it wrote this checkpoint."""
    return progress_of(checkpoint)["env_steps"]


def progress_of(checkpoint):
    with checkpoint.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    return json.loads(header["__metadata__"]["progress"])


def at_low_priority():
    """Called in the process of a training: sets the lowest priority, and lets it save and end if this program is killed."""
    os.nice(19)
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)


class Stopped(Exception):
    pass


def stop(number, _):
    raise Stopped(number)


def train(experiment):
    """Trains all runs until they end or are stopped. Returns whether none failed."""
    for run in experiment.all_runs():
        run.expect_settings()
        # It may have reached a pause when this program was killed.
        run.keep_copy()
    experiment.copy_program()
    said, at_work = set(), {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    try:
        while True:
            for run in [run for run, child in at_work.items() if child.poll() is not None]:
                child = at_work.pop(run)
                if child.returncode != 0:
                    run.failed = f"exit code {child.returncode}:\n{run.last_words()}"
                    say(f"{run.name()} failed, {run.failed}")
                else:
                    run.keep_copy()
                    say(f"{run.name()}: {run.position():,} steps")
            ready = []
            for run in experiment.all_runs():
                if run in at_work or run.failed or run.pause() is None:
                    continue
                verdict = experiment.verdict(run.variant, run.position())
                if verdict is None:
                    ready.append(run)
                elif verdict != "waits" and run.variant not in said:
                    said.add(run.variant)
                    say(f"{run.variant} is stopped: {verdict}")
            # The least advanced run first, so that all can be compared early; the base before the variants.
            ready.sort(key=lambda run: (run.pause(), run.variant != "base"))
            for run in ready[:experiment.runs - len(at_work)]:
                run.keep_copy()
                at_work[run] = run.start()
            if not at_work:
                return not any(run.failed for run in experiment.all_runs())
            time.sleep(1)
    except Stopped as stopped:
        for child in at_work.values():
            child.terminate()
        for child in at_work.values():
            child.wait()
        say("stopped; the same command resumes")
        sys.exit(128 + stopped.args[0])


def say(text):
    print(f"{datetime.datetime.now():%H:%M:%S} {text}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--program", type=pathlib.Path, default=ROOT / "target/release/shadow-repose")
    parser.add_argument("--table", action="store_true", help="print the tables so far, without training")
    parser.add_argument("--publish", type=pathlib.Path, metavar="FOLDER",
                        help="write thinned metrics, settings and results to FOLDER, without training")
    args = parser.parse_args()
    if not args.file.is_file() or not args.program.is_file():
        sys.exit(f"{args.program if args.file.is_file() else args.file}: there is no such file")
    experiment = Experiment(args.file, args.folder.resolve(), args.program.resolve())
    only_looks = args.table or args.publish is not None
    if only_looks:
        for run in experiment.all_runs():
            run.expect_settings()
    whole = only_looks or train(experiment)
    print(compare.tables(experiment))
    runs = [run.path for run in experiment.all_runs() if (run.path / "metrics.csv").exists()]
    if args.publish:
        compare.publish(experiment, args.publish)
    elif runs:
        compare.draw(experiment.drawer(), runs, experiment.folder / "picture.svg", smooth=25)
    return 0 if whole else 1


if __name__ == "__main__":
    sys.exit(main())
