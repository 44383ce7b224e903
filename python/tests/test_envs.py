"""Environments that step together: what they return, and that they return the same bits."""
import copy
import hashlib
import pickle

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from shadow_repose import Env, Policy, VectorEnv

SHORT = {"env.max_episode_seconds": 0.05, "env.fall_dist": 10.0}  # episodes of 5 steps that nothing else ends


def actions(steps, count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count, 20)).astype(np.float32)


def digest(envs, steps=40):
    """Returns a digest of everything that a reset and some steps return."""
    found = hashlib.sha256(envs.reset()[0].tobytes())
    for given in actions(steps, envs.num_envs):
        for part in envs.step(given)[:4]:
            found.update(part.tobytes())
    return found.hexdigest()


def equal(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one[:4], other[:4], strict=True))


def test_shapes_types_and_names():
    envs = VectorEnv(8, seed=3)
    observations, info = envs.reset()
    assert observations.shape == envs.observation_space.shape and observations.dtype == np.float32 and info == {}
    assert observations in envs.observation_space and len(envs) == 8
    observations, rewards, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert (rewards.shape, rewards.dtype, terminated.dtype, truncated.dtype) == ((8,), np.float32, np.bool_, np.bool_)
    assert info == {} and envs.env_steps == 8 and envs.max_episode_steps == 1000 and envs.step_dt == 0.01
    assert envs.observation_layout["cube_quat"] == slice(51, 55) and envs.observation_layout["previous_action"].stop == 157
    assert envs.settings["env.ctrl_dt"] == 0.01 and len(envs.settings["hand.actuators"]) == 20


def test_everything_that_is_returned_is_new_memory():
    envs = VectorEnv(4, seed=1)
    first, _ = envs.reset()
    kept = first.copy()
    given = np.zeros((4, 20), np.float32)
    second, *_ = envs.step(given)
    second[:] = 7.0
    third, *_ = envs.step(given)
    assert np.array_equal(first, kept) and not np.shares_memory(second, third) and not (third == 7.0).any()
    assert not given.any()


@pytest.mark.parametrize("training", [False, True])
def test_results_are_the_same_bits_on_any_number_of_threads(training):
    made = {"seed": 7, "training": training, "random_age": training, "set": {"env.max_episode_seconds": 0.3}}
    assert len({digest(VectorEnv(96, threads=threads, **made)) for threads in (1, 2, 3, 8)}) == 1


def test_the_first_episodes_of_few_hands_are_those_of_the_first_of_many():
    few, many = VectorEnv(5, seed=7), VectorEnv(70, seed=7)
    assert np.array_equal(few.reset()[0], many.reset()[0][:5])
    for given in actions(10, 70):
        assert np.array_equal(few.step(given[:5])[0], many.step(given)[0][:5])


def test_a_seed_starts_the_same_episodes_again_and_none_goes_on_with_the_next():
    envs = VectorEnv(6, seed=5)
    first, second = envs.reset()[0], envs.reset()[0]
    assert not np.array_equal(first, second)
    assert np.array_equal(envs.reset(seed=5)[0], first) and np.array_equal(envs.reset()[0], second)
    assert not np.array_equal(envs.reset(seed=6)[0], first)


def test_a_state_goes_on_bit_for_bit_whether_it_is_set_pickled_or_copied():
    # The lesson changes from iteration to iteration, and the state is taken in the middle of one.
    steep = {"training.tolerance": {"from": 3.0, "to": 0.1, "steps": 2000}, "training.task_reward": {"from": 0.0, "to": 1.0, "steps": 2000}}
    made = {"training": True, "set": {"env.max_episode_seconds": 0.3, **steep}}
    envs = VectorEnv(16, seed=2, random_age=True, **made)
    digest(envs)
    others = [pickle.loads(pickle.dumps(envs)), copy.deepcopy(envs), VectorEnv(16, **made)]
    others[2].reset(seed=99)
    assert others[2].set_state(envs.get_state()).shape == envs.observation_space.shape
    for given in actions(40, 16, seed=1):
        expected = envs.step(given)
        for other in others:
            found = other.step(given)
            assert equal(found, expected)
            if "final_info" in expected[4]:
                rewards = [info["final_info"]["episode"]["r"] for info in (found[4], expected[4])]
                assert np.array_equal(*rewards)
    assert [other.env_steps for other in others] == [envs.env_steps] * 3


def test_a_state_of_other_hands_is_refused_and_then_the_hands_must_be_reset():
    envs = VectorEnv(4)
    envs.reset()
    state = envs.get_state()
    other = VectorEnv(5)
    other.reset()
    rounded, negative = state["numbers"].astype(np.float32), state["seeds"].astype(np.int64) - 9
    for wrong in (
        other.get_state(), {}, {**state, "numbers": rounded}, {**state, "seeds": negative},
        {**state, "numbers": state["numbers"][:, :-1]}, {**state, "ends": state["ends"] + 9},
    ):
        with pytest.raises(ValueError):
            envs.set_state(wrong)
    with pytest.raises(RuntimeError, match="could not be set"):
        envs.step(np.zeros((4, 20)))
    envs.reset()
    envs.step(np.zeros((4, 20)))


def test_a_hand_restarts_in_the_step_that_ends_its_episode():
    envs = VectorEnv(3, set=SHORT, seed=4)
    envs.reset()
    for _ in range(4):
        assert envs.step(np.ones((3, 20)))[4] == {}
    observations, rewards, terminated, truncated, info = envs.step(np.ones((3, 20)))
    assert truncated.all() and not terminated.any() and info["_final_obs"].all()
    previous = envs.observation_layout["previous_action"]
    assert (info["final_obs"][:, previous] == 1).all() and not observations[:, previous].any()
    episode = info["final_info"]["episode"]
    assert (episode["l"] == 5).all() and info["final_info"]["_episode"].all() and info["_final_info"].all()
    assert np.allclose(episode["r"], sum(episode["reward"][name] for name in ("rotation", "distance", "action", "bonus", "fall")), atol=1e-5)


def test_a_hand_restarts_in_place_of_the_next_step_or_only_when_it_is_told():
    made = {"set": SHORT, "seed": 4}
    modes = (AutoresetMode.SAME_STEP, "NextStep", "DISABLED")
    same, following, disabled = (VectorEnv(3, autoreset_mode=mode, **made) for mode in modes)
    for envs in (same, following, disabled):
        envs.reset()
        for _ in range(4):
            envs.step(np.ones((3, 20)))
    last = same.step(np.ones((3, 20)))
    for envs in (following, disabled):
        found = envs.step(np.ones((3, 20)))
        assert np.array_equal(found[0], last[4]["final_obs"]) and "final_obs" not in found[4]
        assert np.array_equal(found[4]["final_info"]["episode"]["r"], last[4]["final_info"]["episode"]["r"])
    begun = following.step(np.full((3, 20), 0.5))
    assert np.array_equal(begun[0], last[0]) and not begun[1].any() and not begun[3].any()
    with pytest.raises(RuntimeError, match="hand 0 is over: reset it"):
        disabled.step(np.ones((3, 20)))
    shown, _ = disabled.reset(options={"reset_mask": np.array([True, False, True])})
    assert np.array_equal(shown[[0, 2]], last[0][[0, 2]]) and np.array_equal(shown[1], last[4]["final_obs"][1])
    with pytest.raises(RuntimeError, match="hand 1 is over"):
        disabled.step(np.ones((3, 20)))


def test_a_restart_that_is_due_is_part_of_the_state():
    envs = VectorEnv(3, set=SHORT, autoreset_mode="NextStep")
    envs.reset()
    for _ in range(5):
        envs.step(np.ones((3, 20)))
    again = pickle.loads(pickle.dumps(envs))
    for _ in range(3):
        expected, found = envs.step(np.ones((3, 20))), again.step(np.ones((3, 20)))
        assert equal(found, expected)
    disabled = VectorEnv(3, set=SHORT, autoreset_mode="DISABLED")
    disabled.reset()
    for _ in range(5):
        disabled.step(np.ones((3, 20)))
    with pytest.raises(RuntimeError, match="is over"):
        copy.deepcopy(disabled).step(np.ones((3, 20)))


def test_a_state_with_hands_that_wait_is_not_one_of_hands_that_never_do():
    waiting = VectorEnv(3, set=SHORT, autoreset_mode="DISABLED")
    waiting.reset()
    for _ in range(5):
        waiting.step(np.ones((3, 20)))
    never = VectorEnv(3, set=SHORT)
    with pytest.raises(ValueError, match="autoreset_mode"):
        never.set_state(waiting.get_state())
    never.reset()
    for _ in range(5):
        never.step(np.ones((3, 20)))
    waiting.set_state(never.get_state())
    assert equal(waiting.step(np.ones((3, 20))), never.step(np.ones((3, 20))))


def test_hands_of_a_subclass_are_copied_with_what_they_know(tmp_path, monkeypatch):
    (tmp_path / "task.toml").write_text("[env]\nfriction_scale = 0.5\nnum_envs = 3\n[ppo]\nminibatches = 6\n")
    monkeypatch.chdir(tmp_path)

    class Mine(VectorEnv):
        def __init__(self, name):
            super().__init__(2, config="task.toml")
            self.name = name

    envs = Mine("mine")
    envs.reset()
    envs.action_space.seed(3)
    monkeypatch.chdir("/")
    again = copy.deepcopy(envs)
    assert (again.name, again.settings["env.friction_scale"]) == ("mine", 0.5)
    assert np.array_equal(again.action_space.sample(), envs.action_space.sample())
    envs.close()
    with pytest.raises(RuntimeError, match="closed"):
        copy.deepcopy(envs)


def test_masks_are_memory_of_their_own_and_only_first_episodes_are_aged():
    envs = VectorEnv(3, set=SHORT, random_age=True, autoreset_mode="DISABLED")
    envs.reset()
    envs.reset(options={"reset_mask": np.array([True, True, False])})
    lengths = []
    for _ in range(5):
        mask = envs.step(np.ones((3, 20)))[3]
        lengths.append(mask.copy())
        if mask.any() and len(lengths) < 5:
            envs.reset(options={"reset_mask": mask})
    assert lengths[4][:2].all() and not np.array(lengths)[:4, :2].any()
    same = VectorEnv(3, set=SHORT)
    same.reset()
    [info] = [same.step(np.ones((3, 20)))[4] for _ in range(5)][4:]
    info["_final_info"][0] = False
    assert info["final_info"]["_episode"].all() and info["_final_obs"].all()


def test_a_mask_restarts_some_hands_and_leaves_the_others():
    envs, untouched = VectorEnv(4, seed=1), VectorEnv(4, seed=1)
    for one in (envs, untouched):
        one.reset()
        one.step(np.ones((4, 20)))
    mask = np.array([False, True, False, False])
    observations, _ = envs.reset(options={"reset_mask": mask})
    expected = untouched.step(np.ones((4, 20)))[0]
    assert np.array_equal(envs.step(np.ones((4, 20)))[0][~mask], expected[~mask])
    assert not observations[1, envs.observation_layout["previous_action"]].any()
    for wrong in (np.zeros(4, bool), np.ones(3, bool), np.ones(4), [1, 0]):
        with pytest.raises((TypeError, ValueError), match="reset_mask"):
            envs.reset(options={"reset_mask": wrong})
    with pytest.raises(ValueError, match="give no seed"):
        envs.reset(seed=1, options={"reset_mask": mask})


def test_one_environment_continues_from_a_state_before_and_after_the_end_of_an_episode():
    env, still = Env(set=SHORT), np.zeros(20)
    env.reset(seed=1)
    running = env.vector.get_state()
    while not env.step(still)[3]:
        pass
    over = env.vector.get_state()
    for other in (env, Env(set=SHORT)):
        other.vector.set_state(running)
        assert not other.step(still)[3]
        other.vector.set_state(over)
        with pytest.raises(ResetNeeded):
            other.step(still)
        other.reset()
        other.step(still)


def test_a_new_goal_goes_on_or_truncates_as_it_is_asked():
    often = {"training.goal_lifetime": 3, "env.max_episode_seconds": 1.0, "env.fall_dist": 10.0}
    made = {"num_envs": 16, "set": often, "training": True, "seed": 1}
    goes_on, cuts = VectorEnv(**made), VectorEnv(**made, goal_change="truncate")
    assert np.array_equal(goes_on.reset()[0], cuts.reset()[0])
    goal, redirected = goes_on.observation_layout["goal_quat"], 0
    before = goes_on.reset(seed=1)[0]
    cuts.reset(seed=1)
    for given in actions(60, 16):
        one, other = goes_on.step(given), cuts.step(given)
        assert np.array_equal(one[0], other[0]) and np.array_equal(one[1], other[1])
        assert not one[3].any()
        for name in ("redirected", "_redirected"):
            assert np.array_equal(other[3], other[4].get(name, np.zeros(16, bool)))
        assert "final_obs" not in one[4] and "final_info" not in other[4]
        if other[3].any():
            redirected += other[3].sum()
            assert np.array_equal(other[4]["final_obs"][other[3]][:, goal], before[other[3]][:, goal])
            assert (other[0][other[3]][:, goal] != before[other[3]][:, goal]).any(axis=1).all()
            assert not other[4]["final_obs"][~other[3]].any()
        before = other[0]
    assert redirected > 100
    with pytest.raises(ValueError, match="SAME_STEP"):
        VectorEnv(2, goal_change="truncate", autoreset_mode="NextStep")


def test_the_terms_of_a_step_add_up_to_its_reward_even_in_the_step_that_ends_an_episode():
    made = {"num_envs": 8, "set": SHORT, "reward_terms": True}
    for envs in (VectorEnv(**made), VectorEnv(**made, training=True), VectorEnv(**made, training=True, autoreset_mode="NextStep")):
        envs.reset()
        for given in actions(12, 8):
            _, rewards, _, _, info = envs.step(given)
            terms = [value for name, value in info["reward"].items() if not name.startswith("_")]
            assert np.allclose(sum(terms), rewards, atol=1e-5) and info["_reward"].all()
            assert (info["rot_dist"] >= 0).all() and (info["rot_dist"] <= np.pi).all()
    assert len(terms) == 9


def test_the_sum_of_rewards_of_an_episode_is_that_of_the_rewards_that_were_returned():
    envs = VectorEnv(8, set=SHORT, training=True, random_age=True)
    envs.reset()
    sums, seen = np.zeros(8), 0
    for given in actions(23, 8):
        _, rewards, terminated, truncated, info = envs.step(given)
        sums += rewards
        over = terminated | truncated
        if over.any():
            assert np.array_equal(info["final_info"]["episode"]["r"][over], sums[over])
            seen += over.sum()
            sums[over] = 0
    assert seen > 30


def test_the_lesson_follows_the_steps_that_the_user_sets():
    made = {"set": {"training.task_reward": {"from": 0.5, "to": 1.0, "steps": 1000}}, "training": True}
    early, late = VectorEnv(8, **made), VectorEnv(8, **made)
    late.env_steps = 10**9
    rewards = []
    for envs in (early, late):
        envs.reset()
        rewards.append(envs.step(np.zeros((8, 20)))[1])
    assert late.env_steps == 10**9 + 8 and (rewards[0] != rewards[1]).all()
    paused = VectorEnv(8, set=SHORT, autoreset_mode="NextStep")
    paused.reset()
    [paused.step(np.zeros((8, 20))) for _ in range(6)]
    assert paused.env_steps == 5 * 8, "a restart is no step"


def test_the_task_is_that_of_the_policy():
    policy = Policy.load("builtin")
    envs = VectorEnv(4, policy=policy, seed=1)
    assert envs.settings == policy.settings != VectorEnv(1).settings
    assert envs.settings["env.act_moving_average"] == 0.7
    changed = VectorEnv(4, policy="builtin", set={"env.friction_scale": 0.5})
    assert {key for key, value in changed.settings.items() if policy.settings[key] != value} == {"env.friction_scale"}
    learning = VectorEnv(4, policy="builtin", training=True)
    assert learning.settings == policy.settings


def test_one_hand_is_a_gymnasium_environment():
    env = Env(set=SHORT, seed=1, reward_terms=True)
    observation, _ = env.reset(seed=2)
    assert np.array_equal(observation, VectorEnv(1).reset(seed=2)[0][0])
    for step in range(5):
        observation, reward, terminated, truncated, info = env.step(np.ones(20))
    assert (type(reward), terminated, truncated) == (float, False, True) and info["final_info"]["episode"]["l"] == 5
    assert abs(sum(info["reward"].values()) - reward) < 1e-5
    assert (observation[env.vector.observation_layout["previous_action"]] == 1).all()
    with pytest.raises(Exception, match="over: reset"):
        env.step(np.ones(20))
    assert env.reset()[0].shape == env.observation_space.shape


@pytest.mark.parametrize(
    ("options", "error", "part"),
    [
        ({"num_envs": 0}, ValueError, "num_envs = 0"),
        ({"num_envs": -1}, ValueError, "num_envs = -1"),
        ({"num_envs": 10**6}, ValueError, "65536"),
        ({"num_envs": 2.5}, TypeError, "whole number"),
        ({"num_envs": "8"}, TypeError, "whole number"),
        ({"threads": 60_000}, ValueError, "worker threads"),
        ({"threads": 2**64}, ValueError, "threads ="),
        ({"seed": -1}, ValueError, "seed = -1"),
        ({"seed": 2**64}, ValueError, "seed ="),
        ({"set": {"env.foo": 1}}, ValueError, "unknown key"),
        ({"set": {"env.sim_dt": -1, "env.friction_scale": "x"}}, ValueError, "friction_scale"),
        ({"set": {"env.num_envs": 3}}, ValueError, "is num_envs"),
        ({"set": {"ppo.gamma": 0.9}}, ValueError, "setting of a learner"),
        ({"set": {"training.hold": 3}}, ValueError, "training=True"),
        ({"set": {"env.sim_dt": object()}}, TypeError, "a setting cannot be"),
        ({"set": {1: 1}}, TypeError, "must be a string"),
        ({"set": [1]}, TypeError, "must be a dict"),
        ({"set": {"env.model": "/nowhere.xml"}}, ValueError, "nowhere.xml"),
        ({"config": "/nowhere.toml"}, FileNotFoundError, "nowhere.toml"),
        ({"config": "/"}, ValueError, "/"),
        ({"config": "x\0y"}, ValueError, "NUL byte"),
        ({"policy": "/nowhere"}, FileNotFoundError, "nowhere"),
        ({"policy": "builtin", "config": "x.toml"}, ValueError, "not both"),
        ({"policy": 3}, TypeError, "PathLike"),
        ({"goal_change": "end"}, ValueError, "goal_change"),
        ({"autoreset_mode": "never"}, ValueError, "SAME_STEP"),
        ({"autoreset_mode": [1]}, ValueError, "SAME_STEP"),
        ({"policy": "zero"}, FileNotFoundError, "zero"),
        ({"render_mode": "human"}, ValueError, "must be .rgb_array"),
        ({"nonsense": 1}, TypeError, "nonsense"),
    ],
)
def test_what_hands_cannot_be_made_of_is_refused_in_a_sentence(options, error, part):
    with pytest.raises(error, match=part):
        VectorEnv(**{"num_envs": 2, **options})


@pytest.mark.parametrize(
    ("given", "part"),
    [
        (np.zeros((3, 20)), r"\(3, 20\), expected \(4, 20\)"),
        (np.zeros((4, 19)), "expected"),
        (np.zeros((20, 4)).T[:, :19], "expected"),
        (np.full((4, 20), np.nan), r"actions\[0, 0\] is NaN"),
        ([[0.0] * 20] * 3 + [[0.0] * 19 + [np.nan]], r"actions\[3, 19\] is NaN"),
    ],
)
def test_actions_that_are_no_actions_are_refused_and_the_hands_go_on(given, part):
    envs = VectorEnv(4, seed=1)
    envs.reset()
    with pytest.raises(ValueError, match=part):
        envs.step(given)
    untouched = VectorEnv(4, seed=1)
    untouched.reset()
    assert equal(envs.step(np.zeros((4, 20))), untouched.step(np.zeros((4, 20))))


@pytest.mark.parametrize("given", [None, "left", 3, np.zeros((4, 20), complex), np.zeros((4, 20), "M8[s]"), np.zeros(20), np.zeros((4, 20, 1)), {}, [[1]], np.zeros((4, 20), "U3"), object()])
def test_what_is_no_array_of_actions_is_an_exception(given):
    envs = VectorEnv(4)
    envs.reset()
    with pytest.raises((TypeError, ValueError)):
        envs.step(given)


def test_any_layout_of_memory_and_any_number_type_are_the_same_actions():
    given = actions(1, 4)[0]
    expected = None
    wide = np.zeros((4, 40), np.float32)
    wide[:, ::2] = given
    for same in (given, given.astype(np.float64), np.asfortranarray(given), wide[:, ::2], given[::-1][::-1], given.tolist()):
        envs = VectorEnv(4, seed=1)
        envs.reset()
        found = envs.step(same)
        expected = expected or found
        assert equal(found, expected)
    huge = VectorEnv(4, seed=1)
    huge.reset()
    clipped = VectorEnv(4, seed=1)
    clipped.reset()
    assert equal(huge.step(np.full((4, 20), np.inf)), clipped.step(np.ones((4, 20))))
    assert np.isfinite(huge.step(np.full((4, 20), -1e38))[0]).all()


def test_hands_step_only_after_a_reset_and_not_after_close():
    envs = VectorEnv(2)
    with pytest.raises(RuntimeError, match="reset the hands"):
        envs.step(np.zeros((2, 20)))
    with pytest.raises(RuntimeError, match="reset the hands"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset()
    envs.close()
    envs.close()
    for call in (lambda: envs.step(np.zeros((2, 20))), envs.reset, envs.get_state, lambda: envs.env_steps, lambda: envs.settings):
        with pytest.raises(RuntimeError, match="closed"):
            call()


def test_what_world_changes_is_unknown_to_the_model_that_predicts():
    late = {"env.prediction": 5}
    heavy = {"env.gravity": [0.0, 0.0, 5.0]}
    first = {}
    for name, set, world in [("usual", late, None), ("world", late, heavy), ("both", late | heavy, None)]:
        envs = VectorEnv(2, threads=1, seed=3, set=set, world=world)
        first[name], _ = envs.reset(seed=3)
        envs.step(np.zeros((2, 20), np.float32))
        envs.close()
    assert np.array_equal(first["usual"], first["world"])
    assert not np.array_equal(first["usual"], first["both"])
    with pytest.raises(ValueError, match="env.noise: `world` holds only"):
        VectorEnv(2, world={"env.noise": {"joint_pos": 0.01}})
