"""Steps environments without a learner, in Python and in turn: `shadow_repose.VectorEnv`, and ppo_peer.py compiled by PyTorch.

Usage: python environments.py [--pairs 11] [--threads 2] [--hands 1024]
Needs: the package shadow_repose, torch, numpy, mujoco==3.17.0, and a C++ compiler. Keep the machine idle.

Both sides get the same random actions, one array for each step of all environments, and return observations and rewards as arrays.
Only ours also computes final observations of environments that dropped the cube, and statistics of episodes.
"""
import argparse
import statistics
import subprocess
import sys
import time

STEPS = 16


def ours(hands, threads):
    from shadow_repose import VectorEnv

    envs = VectorEnv(hands, threads=threads, training=True, goal_change="truncate", random_age=True)
    envs.reset(seed=1)
    return envs.step


def peer(hands, threads):
    import torch

    import ppo_peer

    torch.set_num_threads(threads)
    torch.set_grad_enabled(False)
    envs = ppo_peer.Hands(ppo_peer.SCENE, hands, threads, ppo_peer.BatchPhysics, lambda f: torch.compile(f, dynamic=False))
    envs.age[:] = torch.randint(0, ppo_peer.EPISODE, (hands,))
    lesson = torch.tensor([0.4, 3, 0.3, -50])

    def step(actions):
        _, terminated, truncated, redirected = envs.step(torch.from_numpy(actions), lesson)
        seen = envs.observe()
        over, changed = (terminated | truncated).nonzero()[:, 0], redirected.nonzero()[:, 0]
        envs.redirect(changed)
        if len(over):
            envs.begin(over)
        if len(over) or len(changed):
            envs.observe_again(seen, torch.cat([over, changed]))

    return step


def side(name, hands, threads):
    """Steps on each line of standard input, and prints the seconds."""
    import numpy as np

    step, rng = {"ours": ours, "peer": peer}[name](hands, threads), np.random.default_rng(0)
    for _ in sys.stdin:
        actions = (0.6 * rng.standard_normal((STEPS, hands, 20))).astype(np.float32)
        began = time.perf_counter()
        for given in actions:
            step(given)
        print(time.perf_counter() - began, flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--pairs", type=int, default=11)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--hands", type=int, default=1024)
    parser.add_argument("--side", choices=["ours", "peer"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.side:
        return side(args.side, args.hands, args.threads)
    command = [sys.executable, "-W", "ignore", __file__, "--threads", str(args.threads), "--hands", str(args.hands), "--side"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    both = [subprocess.Popen([*command, name], **pipes) for name in ("ours", "peer")]

    def turn(one):
        time.sleep(0.5)  # until the threads of the other side sleep
        one.stdin.write("\n")
        one.stdin.flush()
        return STEPS * args.hands / float(one.stdout.readline())

    for _ in range(8):  # compilation and first episodes
        [turn(one) for one in both]
    pairs = [[statistics.harmonic_mean((turn(one), turn(one))) for one in both] for _ in range(args.pairs)]
    ratios = [a / b for a, b in pairs]
    medians = [statistics.median(figures) for figures in zip(*pairs, strict=True)]
    print("| ours, steps/s | peer, steps/s | ratio: median (range) |\n|---|---|---|")
    print(f"| {medians[0]:.0f} | {medians[1]:.0f} | {statistics.median(ratios):.2f} ({min(ratios):.2f} … {max(ratios):.2f}) |")
    for one in both:
        one.stdin.close()
        one.wait()


main()
