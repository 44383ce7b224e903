"""FastTD3 in one file: TD3 off policy with many environments, large batches and distributional critics.

    pip install torch
    python fast_td3.py --total-steps 10_000_000 --device cuda --bf16

After Seo, Sferrazza et al., "FastTD3: Simple, fast, and capable reinforcement learning for humanoid control" (2025). The rewards are the
same as in `shadow-repose train`. An evaluation plays whole episodes and scores the task itself. Rows go to standard output as CSV.
`shadow-repose plot` draws such a table.
"""
import argparse
import copy
import time

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from shadow_repose import VectorEnv, evaluate

GAMMA, TAU, REWARD_SCALE = 0.99, 0.1, 0.01
LOW, HIGH, ATOMS = -10.0, 30.0, 101  # the values that the critics distinguish
NOISE, TARGET_NOISE, NOISE_CLIP = (0.05, 0.6), 0.1, 0.3  # each environment explores with a noise of its own


def mlp(*sizes):
    layers = [part for a, b in zip(sizes, sizes[1:], strict=False) for part in (nn.Linear(a, b), nn.LayerNorm(b), nn.SiLU())]
    return nn.Sequential(*layers[:-2])


class Normal(nn.Module):
    """The statistics of observations, and rows normalised by them."""

    def __init__(self, size):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.tensor(1e-4))

    def see(self, rows):
        mean, var, count = rows.mean(0), rows.var(0, correction=0), len(rows)
        total, delta = self.count + count, mean - self.mean
        self.var = (self.var * self.count + var * count + delta**2 * self.count * count / total) / total
        self.mean, self.count = self.mean + delta * count / total, total

    def forward(self, rows):
        return ((rows - self.mean) / (self.var + 1e-5).sqrt()).clamp(-5, 5)


class Twins(nn.Module):
    """Two critics, each a distribution over values."""

    def __init__(self, observations, actions):
        super().__init__()
        self.nets = nn.ModuleList(mlp(observations + actions, 512, 256, 128, ATOMS) for _ in range(2))
        self.register_buffer("atoms", torch.linspace(LOW, HIGH, ATOMS))

    def forward(self, rows, actions):
        return [net(torch.cat((rows, actions), 1)).float() for net in self.nets]

    def values(self, logits):
        return (logits.softmax(1) * self.atoms).sum(1)

    def target(self, rows, actions, rewards, discounts):
        """Returns the distribution of reward + discount x value by the twin that expects less, moved to the atoms."""
        both = self(rows, actions)
        expected = torch.stack([self.values(logits) for logits in both])
        chosen = torch.where((expected[0] < expected[1])[:, None], both[0], both[1]).softmax(1)
        place = (rewards[:, None] + discounts[:, None] * self.atoms).clamp(LOW, HIGH).sub(LOW).div((HIGH - LOW) / (ATOMS - 1))
        below = place.floor().clamp(max=ATOMS - 2)
        share, index = place - below, below.long()
        target = torch.zeros_like(chosen)
        return target.scatter_add_(1, index, chosen * (1 - share)).scatter_add_(1, index + 1, chosen * share)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=10_000_000)
    parser.add_argument("--hands", type=int, default=1024)
    parser.add_argument("--buffer", type=int, default=512, help="steps of each hand that are kept")
    parser.add_argument("--batch", type=int, default=8192)
    parser.add_argument("--updates", type=int, default=2, help="gradient steps per step of all hands")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bf16", action="store_true", help="compute in bfloat16: faster on a GPU, or on a CPU with AMX or AVX-512 BF16")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    device, n, kept = torch.device(args.device), args.hands, args.buffer
    # Actions are smoothed as in `evaluate` throughout. The program's own training smooths them less and less.
    same = {"env.act_moving_average": 0.25}
    envs = VectorEnv(n, training=True, goal_change="truncate", random_age=True, seed=args.seed, set=same)
    size, width = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    normal, actor, critic = Normal(size), nn.Sequential(mlp(size, 512, 256, 128, width), nn.Tanh()), Twins(size, width)
    nn.init.normal_(actor[0][-1].weight, 0, 0.01)
    for net in (normal, actor, critic):
        net.to(device)

    def act(rows):
        with torch.no_grad():
            return actor(normal(torch.from_numpy(rows).to(device))).cpu().numpy()

    slow = copy.deepcopy(critic)
    optimizers = [torch.optim.AdamW(net.parameters(), 3e-4, weight_decay=0.1) for net in (actor, critic)]
    seen, following = (torch.zeros(kept, n, size, device=device) for _ in range(2))
    acted, rewards, discounts = (torch.zeros(kept, n, *shape, device=device) for shape in ((width,), (), ()))
    low, high = NOISE
    noise = low + (high - low) * torch.rand(n, 1, device=device)
    row = torch.from_numpy(envs.reset()[0]).to(device)
    began, steps, said = time.time(), args.total_steps // n, []
    print("env_steps,seconds,reward,eval/goals,eval/rot_dist,eval/drop_rate,value", flush=True)
    for step in range(1, steps + 1):
        at = (step - 1) % kept
        normal.see(row)
        with torch.no_grad():
            action = (actor(normal(row)) + noise * torch.randn(n, width, device=device)).clamp(-1, 1)
        found, reward, terminated, truncated, info = envs.step(action.cpu().numpy())
        after = found.copy()
        after[truncated] = info["final_obs"][truncated] if truncated.any() else 0
        seen[at], acted[at], following[at] = row, action, torch.from_numpy(after).to(device)
        rewards[at] = REWARD_SCALE * torch.from_numpy(reward).to(device)
        discounts[at] = GAMMA * (1 - torch.from_numpy(terminated).to(device).float())
        row = torch.from_numpy(found).to(device)
        for update in range(args.updates if step > 10 else 0):
            picked = torch.randint(min(step, kept) * n, (args.batch,), device=device)
            one, two, taken = (part.flatten(0, 1)[picked] for part in (seen, following, acted))
            one, two = normal(one), normal(two)
            with torch.autocast(device.type, torch.bfloat16, enabled=args.bf16):
                with torch.no_grad():
                    blur = (TARGET_NOISE * torch.randn_like(taken)).clamp(-NOISE_CLIP, NOISE_CLIP)
                    target = slow.target(two, (actor(two) + blur).clamp(-1, 1), rewards.flatten()[picked], discounts.flatten()[picked])
                loss = sum(-(target * F.log_softmax(logits, 1)).sum(1).mean() for logits in critic(one, taken))
            optimizers[1].zero_grad()
            loss.backward()
            optimizers[1].step()
            if update % 2 == 0:
                with torch.autocast(device.type, torch.bfloat16, enabled=args.bf16):
                    value = torch.min(*(critic.values(logits) for logits in critic(one, actor(one)))).mean()
                optimizers[0].zero_grad()
                (-value).backward()
                optimizers[0].step()
                said.append(value.item())
            with torch.no_grad():
                for old, new in zip(slow.parameters(), critic.parameters(), strict=True):
                    old.lerp_(new, TAU)
        if step % 800 == 0 or step == steps:
            score = evaluate(act, episodes=64, seed=1_000_003)
            scores = (score["goals_per_episode"], score["rot_dist"], score["drop_rate"])
            facts = (rewards.mean().item() / REWARD_SCALE, *scores, float(np.mean(said[-100:])))
            print(step * n, f"{time.time() - began:.0f}", *(f"{fact:.4f}" for fact in facts), sep=",", flush=True)


main()
