"""Runs the program and its Python peers in turn on this machine and prints the medians of the ratios.

Usage: python compare.py [--pairs 5] [--only NAME ...] [--program PATH] [--threads 2]
Needs: torch, numpy, mujoco==3.17.0 in the Python that runs it, and a prior `cargo build --release`. Keep the machine idle.
"""
import argparse
import csv
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]
LARGE, DEFAULT, SMALL = [512, 512, 256, 128], [512, 256, 128], [256, 128, 64]
# The iterations after which and until which a training is timed: compilation and the first rollouts are over.
ITERATIONS = (10, 30)


def run(command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


class Sides:
    """Measures each figure on either side."""

    def __init__(self, program, threads):
        self.program, self.threads = program, threads

    def bench(self, part, key, *settings):
        options = [x for setting in settings for x in ("--set", setting)]
        threads = ["--threads", str(self.threads)]
        return json.loads(run([self.program, "bench", "--only", part, "--json", *threads, *options]))[key]

    def learner(self, hidden, envs, minibatches, *settings):
        return self.bench("learner", "learner_samples_per_s", f"ppo.hidden={hidden}", f"env.num_envs={envs}",
                          f"ppo.minibatches={minibatches}", *settings)

    def torch(self, hidden, batch, *options):
        return json.loads(run([sys.executable, HERE / "torch_learner.py", "--hidden", ",".join(map(str, hidden)),
                               "--batch", str(batch), "--threads", str(self.threads), *options]))["samples_per_s"]

    def training(self):
        """Returns env steps/s of `train` without options over the iterations in which the peer is timed."""
        steps = ITERATIONS[1] * 16384
        with tempfile.TemporaryDirectory() as folder:
            run([self.program, "train", "--quiet", "--run-dir", f"{folder}/run", "--total-steps", str(steps),
                 "--threads", str(self.threads)])
            rows = list(csv.DictReader(open(f"{folder}/run/metrics.csv")))[ITERATIONS[0]:ITERATIONS[1]]
        seconds = sum(float(row["time/collect_s"]) + float(row["time/update_s"]) for row in rows)
        return 16384 * len(rows) / seconds

    def peer(self, *options):
        """Returns env steps/s of the peer between two of the lines that it prints, one per ten iterations."""
        command = [sys.executable, "-W", "ignore", HERE / "ppo_peer.py", "--iterations", str(ITERATIONS[1]),
                   "--threads", str(self.threads), *options]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as peer:
            seen = [(time.perf_counter(), json.loads(line)) for line in peer.stdout]
        if not seen or seen[-1][1]["iteration"] != ITERATIONS[1]:
            sys.exit("ppo_peer.py has failed")
        (start, first), (end, last) = next(line for line in seen if line[1]["iteration"] == ITERATIONS[0]), seen[-1]
        return (last["env_steps"] - first["env_steps"]) / (end - start)

    def memory(self):
        with tempfile.TemporaryDirectory() as folder:
            command = [self.program, "train", "--run-dir", f"{folder}/run", "--total-steps", "500000",
                       "--threads", str(self.threads)]
            training = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            _, status, usage = os.wait4(training.pid, 0)
            assert status == 0, "the training failed"
        return usage.ru_maxrss / 1024


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--only", nargs="*", help="part of a figure's name")
    parser.add_argument("--program", type=pathlib.Path, default=ROOT / "target/release/shadow-repose")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    sides, all_threads = Sides(args.program, args.threads), str(args.threads)
    figures = {
        "learner samples/s, nets 512 512 256 128, batch 8192": (lambda: sides.learner(LARGE, 512, 1),
                                                                lambda: sides.torch(LARGE, 8192)),
        "learner samples/s, nets 256 128 64, batch 4096": (lambda: sides.learner(SMALL, 1024, 4),
                                                           lambda: sides.torch(SMALL, 4096)),
        "learner samples/s, nets 512 256 128, batch 4096": (lambda: sides.learner(DEFAULT, 1024, 4),
                                                            lambda: sides.torch(DEFAULT, 4096)),
        "learner samples/s, nets 512 256 128, batch 4096, bf16": (
            lambda: sides.learner(DEFAULT, 1024, 4, "ppo.precision=bf16"),
            lambda: max(sides.torch(DEFAULT, 4096, "--bf16"), sides.torch(DEFAULT, 4096, "--bf16", "--compile"))),
        # Measured in turn within one run, so that the speed of the machine is the same for both sides.
        "environments / bare physics": (lambda: sides.bench("physics", "pool_share"), lambda: 1.0),
        "end to end steps/s, default training; batch API, torch.compile": (
            sides.training, lambda: sides.peer("--torch-threads", all_threads, "--compile", "all")),
        "end to end, without torch.compile": (sides.training, lambda: sides.peer("--torch-threads", all_threads)),
        "end to end, mujoco.rollout in place of the batch API": (
            sides.training, lambda: sides.peer("--torch-threads", all_threads, "--physics", "rollout")),
        "end to end, PyTorch on one thread": (sides.training, lambda: sides.peer("--torch-threads", "1")),
    }
    print("| figure | ours | other | ratio: median (range) |\n|---|---|---|---|")
    for name, (ours, other) in figures.items():
        if args.only and not any(part in name for part in args.only):
            continue
        pairs = [(ours(), other()) for _ in range(args.pairs)]
        ratios = [a / b for a, b in pairs]
        medians = [statistics.median(side) for side in zip(*pairs)]
        print(f"| {name} | {medians[0]:.5g} | {medians[1]:.5g} "
              f"| {statistics.median(ratios):.2f} ({min(ratios):.2f} … {max(ratios):.2f}) |", flush=True)
    if not args.only:
        print(f"| resident memory of a training, MiB | {sides.memory():.0f} | | |")


if __name__ == "__main__":
    main()
