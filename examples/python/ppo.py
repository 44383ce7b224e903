"""PPO in one file, in the style of CleanRL: PyTorch learns, on a CPU or a GPU, from environments that step in parallel.

    pip install torch
    python ppo.py --total-steps 10_000_000 --device cuda

The rewards are the same as in `shadow-repose train`, so the curves can be compared. An evaluation plays whole episodes with mean
actions and scores the task itself. Rows go to standard output as CSV. `shadow-repose plot` draws such a table.
"""
import argparse
import time

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from shadow_repose import VectorEnv, evaluate

GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES, REWARD_SCALE = 0.995, 0.95, 0.2, 4, 4, 0.01


class Agent(nn.Module):
    """Actor and critic, and the statistics that normalise what both read."""

    def __init__(self, observations, actions, hidden=(512, 256, 128)):
        super().__init__()

        def mlp(outputs, gain):
            sizes = (observations, *hidden, outputs)
            layers = [nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False)]
            for layer in layers:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            nn.init.orthogonal_(layers[-1].weight, gain)
            return nn.Sequential(*[part for layer in layers for part in (layer, nn.ELU())][:-1])

        self.actor, self.critic = mlp(actions, 0.01), mlp(1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))
        self.register_buffer("mean", torch.zeros(observations))
        self.register_buffer("var", torch.ones(observations))
        self.register_buffer("count", torch.tensor(1e-4))

    def see(self, rows):
        """Adds rows to the statistics."""
        mean, var, count = rows.mean(0), rows.var(0, correction=0), len(rows)
        total, delta = self.count + count, mean - self.mean
        self.var = (self.var * self.count + var * count + delta**2 * self.count * count / total) / total
        self.mean, self.count = self.mean + delta * count / total, total

    def normal(self, rows):
        return ((rows - self.mean) / (self.var + 1e-5).sqrt()).clamp(-5, 5)

    def policy(self, rows):
        return Normal(self.actor(self.normal(rows)), self.log_std.exp())

    def value(self, rows):
        return self.critic(self.normal(rows))[..., 0]

    def act(self, rows):
        """Returns mean actions of rows of NumPy."""
        with torch.no_grad():
            return self.actor(self.normal(torch.from_numpy(rows).to(self.mean.device))).cpu().numpy()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=10_000_000)
    parser.add_argument("--hands", type=int, default=1024)
    parser.add_argument("--horizon", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--save", help="where to write the agent at the end")
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    device, n, steps = torch.device(args.device), args.hands, args.horizon
    # Actions are smoothed as in `evaluate` throughout. The program's own training smooths them less and less.
    same = {"env.act_moving_average": 0.25}
    envs = VectorEnv(n, training=True, goal_change="truncate", random_age=True, seed=args.seed, set=same)
    size, actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    agent = Agent(size, actions).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), 5e-4, eps=1e-5)

    def buffer(*shape):
        return torch.zeros(steps, n, *shape, device=device)

    seen, acted, logged, rewards, ends = buffer(size), buffer(actions), buffer(), buffer(), buffer()
    values = torch.zeros(steps + 1, n, device=device)
    row = torch.from_numpy(envs.reset()[0]).to(device)
    began, iterations = time.time(), args.total_steps // (n * steps)
    print("env_steps,seconds,reward,eval/goals,eval/rot_dist,eval/drop_rate,policy/std,policy/kl", flush=True)
    for iteration in range(1, iterations + 1):
        paid = 0.0
        for t in range(steps):
            with torch.no_grad():
                distribution = agent.policy(row)
                action = distribution.sample()
                seen[t], acted[t], values[t] = row, action, agent.value(row)
                logged[t] = distribution.log_prob(action).sum(1)
            row, reward, terminated, truncated, info = envs.step(action.cpu().numpy())
            paid += reward.mean() / steps
            row, reward = torch.from_numpy(row).to(device), REWARD_SCALE * torch.from_numpy(reward).to(device)
            # Where time is up or the goal is replaced, the value of the last observation replaces the future rewards.
            if truncated.any():
                cut = torch.from_numpy(truncated).to(device)
                with torch.no_grad():
                    reward[cut] += GAMMA * agent.value(torch.from_numpy(info["final_obs"][truncated]).to(device))
            rewards[t], ends[t] = reward, torch.from_numpy(terminated | truncated).to(device)
        with torch.no_grad():
            values[steps] = agent.value(row)
        advantages, last = torch.zeros_like(rewards), 0
        for t in reversed(range(steps)):
            live = 1 - ends[t]
            last = rewards[t] + GAMMA * live * values[t + 1] - values[t] + GAMMA * LAMBDA * live * last
            advantages[t] = last
        targets, advantages = (advantages + values[:-1]).flatten(), advantages.flatten()
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        rows, taken, before = seen.flatten(0, 1), acted.flatten(0, 1), logged.flatten()
        divergences = []
        for _ in range(EPOCHS):
            for batch in torch.randperm(n * steps, device=device).chunk(MINIBATCHES):
                change = agent.policy(rows[batch]).log_prob(taken[batch]).sum(1) - before[batch]
                ratio, gain = change.exp(), advantages[batch]
                surrogate = torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                loss = 2 * (agent.value(rows[batch]) - targets[batch]).square().mean() - surrogate
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
                optimizer.step()
                divergences.append((ratio.detach() - 1 - change.detach()).mean().item())
        agent.see(rows)
        # The step size follows the divergence of the policy, as in rsl_rl.
        rate, divergence = optimizer.param_groups[0]["lr"], float(np.mean(divergences))
        rate *= 1 / 1.5 if divergence > 0.032 else 1.5 if divergence < 0.008 else 1
        optimizer.param_groups[0]["lr"] = min(max(rate, 1e-5), 2e-3)
        if iteration % 50 == 0 or iteration == iterations:
            score = evaluate(agent.act, episodes=64, seed=1_000_003)
            scores = (score["goals_per_episode"], score["rot_dist"], score["drop_rate"])
            facts = (paid, *scores, agent.log_std.exp().mean().item(), divergence)
            print(iteration * n * steps, f"{time.time() - began:.0f}", *(f"{fact:.4f}" for fact in facts), sep=",", flush=True)
    if args.save:
        torch.save(agent.state_dict(), args.save)


main()
