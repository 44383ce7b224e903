"""Learners from other projects, unchanged. Each test runs where its learner is installed."""
import numpy as np
import pytest

from shadow_repose import Env, VectorEnv

LEARNING = {"training": True, "goal_change": "truncate", "random_age": True, "seed": 1}


def test_stable_baselines3_finds_one_hand_in_order():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(Env(set={"env.max_episode_seconds": 0.2}), warn=False)


def test_stable_baselines3_learns_and_hears_of_every_end():
    sb3 = pytest.importorskip("stable_baselines3")
    from shadow_repose.sb3 import Sb3VecEnv

    short = {"env.max_episode_seconds": 0.3, "training.goal_lifetime": 10}
    envs = Sb3VecEnv(VectorEnv(64, set=short, **LEARNING))
    observations = envs.reset()
    ends = {"episode": 0, "goal": 0}
    for _ in range(60):
        observations, rewards, dones, infos = envs.step(np.random.default_rng(0).uniform(-1, 1, (64, 20)))
        for done, info in zip(dones, infos, strict=True):
            assert done == ("terminal_observation" in info)
            if done:
                ends["episode" if "episode" in info else "goal"] += 1
    assert min(ends.values()) > 50 and observations.shape == (64, *envs.observation_space.shape)
    assert envs.get_attr("env_steps", [0, 1]) == [60 * 64] * 2
    learner = sb3.PPO("MlpPolicy", envs, n_steps=16, batch_size=256, n_epochs=1, device="cpu")
    learner.learn(4096)
    assert learner.num_timesteps == 4096 and len(learner.ep_info_buffer) > 0 and "goals" in learner.ep_info_buffer[0]
    with pytest.raises(ValueError, match="SAME_STEP"):
        Sb3VecEnv(VectorEnv(2, autoreset_mode="NextStep"))


def test_what_stable_baselines3_has_learnt_is_a_policy():
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import VecNormalize

    from shadow_repose.sb3 import Sb3VecEnv, policy

    envs = VecNormalize(Sb3VecEnv(VectorEnv(64, **LEARNING)), clip_obs=2.0)
    learner = sb3.PPO("MlpPolicy", envs, n_steps=16, batch_size=256, n_epochs=1, device="cpu")
    learner.learn(4096)
    seen = envs.venv.envs.reset(seed=0)[0]
    theirs, _ = learner.predict(envs.normalize_obs(seen), deterministic=True)
    ours = policy(learner)
    assert np.abs(ours(seen).clip(-1, 1) - theirs).max() < 1e-5
    assert np.allclose(ours.std, np.exp(learner.policy.log_std.detach().numpy()))
    assert np.abs(policy(learner, task=VectorEnv(1))(seen) - ours(seen)).max() == 0
    with pytest.raises(ValueError, match="SAC"):
        policy(sb3.SAC("MlpPolicy", envs, buffer_size=100))


def test_rsl_rl_learns():
    runners = pytest.importorskip("rsl_rl.runners")
    from shadow_repose.rsl_rl import RslRlVecEnv, policy

    envs = RslRlVecEnv(VectorEnv(64, set={"env.max_episode_seconds": 0.3}, **LEARNING))
    network = {"class_name": "MLPModel", "hidden_dims": [32], "activation": "elu", "obs_normalization": True}
    noise = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}
    config = {
        "num_steps_per_env": 8, "save_interval": 1000, "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 2, "learning_rate": 1e-3},
        "actor": {**network, "distribution_cfg": noise}, "critic": network,
    }  # fmt: skip
    runner = runners.OnPolicyRunner(envs, config, log_dir=None, device="cpu")
    runner.learn(20, init_at_random_ep_len=True)
    assert envs.envs.env_steps == 20 * 8 * 64 and envs.episode_length_buf.max() < 31
    seen = envs.get_observations()
    theirs = runner.get_inference_policy()(seen).detach().numpy()
    ours = policy(runner)
    assert np.abs(ours(seen["policy"].numpy()) - theirs).max() < 1e-5
    spread = runner.alg.get_policy().distribution.log_std_param.exp().detach().numpy()
    assert np.allclose(ours.std, spread)
    kept = envs.get_observations()["policy"].clone()
    envs.get_observations()["policy"].fill_(7)
    assert (envs.get_observations()["policy"] == kept).all()
    envs.close()
