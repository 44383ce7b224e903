"""Runs an exported policy in plain Python: MuJoCo for the hand, onnxruntime for the policy, and nothing of shadow-repose.

usage: deploy.py POLICY.onnx --check TRACE           compare observations and actions with a trace of the program
       deploy.py POLICY.onnx --episodes 200 --seed 0 [--json]   play, and print the score

Reset, observe, act, step: that is all a program of your own needs. The scene is the program's, or your own with --scene. Python 3.11
or newer; `pip install -r requirements.txt`.
"""

import argparse
import contextlib
import json
import pathlib
import sys
import tomllib

import mujoco
import numpy as np
import onnxruntime

if not hasattr(mujoco.MjModel, "dof_dampingpoly"):
    sys.exit(f"error: mujoco {mujoco.__version__} is too old: `pip install -r requirements.txt` installs one that is new enough")

SCENE = pathlib.Path(__file__).parents[2] / "assets/shadow_hand/scene.xml"
# Settings that older files do not have.
NOMINAL = dict.fromkeys(["hand_mass_scale", "cube_size_scale", "gains_scale", "damping_scale", "frictionloss_scale"], 1.0)
NOMINAL |= {"cube_com": [0, 0, 0], "gravity": [0, 0, 0], "cone": "scene", "action_delay": 0, "prediction": 0, "noise": {}, "bias": {}}
# Settings in which the world of a trace may differ from the policy's: what moves, and what is late.
OF_WORLD = ["friction_scale", "cube_mass_scale", "hand_mass_scale", "cube_size_scale", "gains_scale", "damping_scale", "frictionloss_scale",
            "cube_com", "gravity", "cone", "sim_dt", "action_delay", "prediction"]
# The factors that a policy can be told, in the order of the observation.
KNOWN = ["cube_mass", "cube_size", "damping", "friction"]
# What the file and its settings must say.
FACTS = set("action_offset action_scale config ema_alpha fingertip_names hinge_names joint_names object_name observation_names "
            "observation_sizes start_keyframe".split())
SETTINGS = set("sim_dt ctrl_dt friction_scale cube_mass_scale goal_position reset_position_noise reset_dof_pos_noise "
               "reset_dof_vel_noise vel_obs_scale fall_dist success_tolerance success_hold max_consecutive_successes "
               "max_episode_seconds".split())
OBSERVATION_LIMIT, ACTION_LIMIT = 1e-6, 1e-5  # how far a check may be off; with a prediction, observations too may be 1e-5 off


@contextlib.contextmanager
def read_from(file):
    """Ends the program with one sentence if the file lacks what is looked for in it."""
    try:
        yield
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        sys.exit(f"error: {file} is incomplete or garbled: {type(error).__name__}: {str(error).split(chr(10))[0]}")


class Policy:
    """The file: `obs` [batch, O] to `actions` [batch, A]. Mirror, symmetry, normaliser and clipping are inside."""

    def __init__(self, path):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # for small products, more threads only wait for each other
        try:
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common class
            sys.exit(f"error: {path} is not an ONNX file that can be run: {error}")
        self.facts = self.session.get_modelmeta().custom_metadata_map
        if missing := FACTS - self.facts.keys():
            sys.exit(f"error: {path} does not say its {', '.join(sorted(missing))}; export it again")

    def numbers(self, key):
        numbers = np.array([float(number) for number in self.facts[key].split(",")])
        if not np.isfinite(numbers).all():
            raise ValueError(f"{key} is not finite")
        return numbers

    def names(self, key):
        return self.facts[key].split(",")

    def act(self, observation):
        action = self.session.run(["actions"], {"obs": observation[None]})[0][0]
        if not np.isfinite(action).all():
            sys.exit("error: the policy's actions are not finite")
        return action


class Hand:
    """The simulated hand: what the policy sees of it, and what its actions do."""

    def __init__(self, policy, scene, other=None):
        """Builds the policy's hand, or one in a world with `other` settings."""
        env = NOMINAL | tomllib.loads(policy.facts["config"])["env"] | (other or {})
        self.env = env
        if missing := SETTINGS - env.keys():
            raise KeyError(f"no env.{', env.'.join(sorted(missing))}")
        for key, value in env.items():
            if isinstance(value, (float, list)) and not np.isfinite(value).all():
                raise ValueError(f"env.{key} is not finite")
        for key in ("noise", "bias"):
            if env[key]:
                sys.exit(f"error: the policy was exported with env.{key}, which this program does not simulate")
        try:
            self.model = varied_model(env, scene, policy)
            joints = [self.model.joint(name) for name in policy.names("hinge_names")]
            self.tips = [frame(self.model, name) for name in policy.names("fingertip_names")]
            self.actuators = [self.model.actuator(name) for name in policy.names("joint_names")]
            cube = self.model.body(policy.facts["object_name"])
        except (KeyError, ValueError) as error:
            sys.exit(f"error: {scene} is not the policy's hand: {str(error.args[0]).splitlines()[0]}; name its scene by --scene FILE")
        self.data = mujoco.MjData(self.model)
        self.substeps = round(env["ctrl_dt"] / env["sim_dt"])
        self.angle = np.array([joint.qposadr[0] for joint in joints])
        self.speed = np.array([joint.dofadr[0] for joint in joints])
        self.limits = np.array([joint.range for joint in joints])
        free = self.model.joint(cube.jntadr[0])
        self.cube, self.cube_speed = free.qposadr[0], free.dofadr[0]
        # Without a keyframe, episodes start in the scene's default pose.
        start = policy.facts["start_keyframe"]
        self.start = self.model.key(int(start)).qpos if start else self.model.qpos0
        # The place of the goal's orientation in the observation. The relative orientation follows it.
        sizes = policy.numbers("observation_sizes").astype(int)
        self.size, self.goal_at = sizes.sum(), sizes[:policy.names("observation_names").index("goal_quat")].sum()
        # An action of -1 … 1 asks for a target within the control range: offset + scale * action.
        self.controls = np.array([actuator.id for actuator in self.actuators])
        self.offset, self.scale = policy.numbers("action_offset"), policy.numbers("action_scale")
        [self.alpha] = policy.numbers("ema_alpha")
        ranges = np.array([actuator.ctrlrange for actuator in self.actuators])
        if not np.allclose(ranges, np.stack([self.offset - self.scale, self.offset + self.scale], 1), rtol=0, atol=1e-9):
            sys.exit(f"error: the actuators of {scene} have other ranges than those that the policy was exported for")
        self.low, self.high = ranges.T
        self.previous_action = np.zeros(len(self.actuators))
        # What `export --set env.known...` has stated of the hand and its object, for a policy that is told.
        told = KNOWN if "known" in policy.names("observation_names") else []
        self.known = np.log([env["known"].get(name, 1.0) for name in told])
        self.goal = np.array([1.0, 0, 0, 0])

    def model_of(self, policy, scene):
        """Returns a hand that predicts: this one, changed by what `export --set env.known...` has stated of it."""
        told = {}
        for name, factor in self.env.get("known", {}).items():
            scale = self.env[f"{name}_scale"]
            if scale == 1:
                told[f"{name}_scale"] = factor
            elif factor not in (1, scale):
                sys.exit(f"error: the policy was exported with env.{name}_scale = {scale} and env.known.{name} = {factor}: give both one value")
        return Hand(policy, scene, told)

    def place(self, qpos, qvel):
        """Sets the positions of everything. Positions of bodies follow."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_step1(self.model, self.data)

    def reset(self, random):
        """Begins an episode: joints near their start, the cube above the palm, both orientations uniformly random."""
        env, qpos = self.env, self.start.copy()
        noise = random.uniform(-env["reset_dof_pos_noise"], env["reset_dof_pos_noise"], len(self.angle))
        qpos[self.angle] = np.clip(qpos[self.angle] + noise, self.limits[:, 0], self.limits[:, 1])
        qvel = np.zeros(self.model.nv)
        qvel[self.speed] = random.uniform(-env["reset_dof_vel_noise"], env["reset_dof_vel_noise"], len(self.angle))
        noise = random.uniform(-env["reset_position_noise"], env["reset_position_noise"], 3)
        qpos[self.cube:self.cube + 3] = env["goal_position"] + noise
        qpos[self.cube + 3:self.cube + 7] = uniform_rotation(random)
        self.place(qpos, qvel)
        self.goal = uniform_rotation(random)
        self.previous_action = np.zeros(len(self.actuators))
        self.start_targets()

    def start_targets(self):
        """Begins with targets where the actuators are, as if they had been sent all the time."""
        self.targets = np.clip(self.data.actuator_length[self.controls], self.low, self.high)
        self.sent = [self.targets] * (1 + max(self.env["action_delay"], self.env["prediction"]))

    def observe(self):
        """Returns the values that the policy sees, in the order of `observation_names`."""
        env, data = self.env, self.data
        cube, speed = data.qpos[self.cube:self.cube + 7], data.qvel[self.cube_speed:self.cube_speed + 6]
        tips = []
        for kind, tip in self.tips:
            # The velocity of the frame's origin in the world frame. MuJoCo gives the angular part first.
            velocity = np.zeros(6)
            mujoco.mj_objectVelocity(self.model, data, kind, tip, velocity, 0)
            position, orientation = data.xpos[tip], data.xquat[tip]
            if kind == mujoco.mjtObj.mjOBJ_SITE:
                body = data.xquat[self.model.site_bodyid[tip]]
                position, orientation = data.site_xpos[tip], product(body, self.model.site_quat[tip])
            tips += [position, orientation, velocity[3:], velocity[:3]]
        return np.concatenate([
            data.qpos[self.angle],
            env["vel_obs_scale"] * data.qvel[self.speed],
            cube[:3],
            positive(cube[3:]),
            speed[:3],
            env["vel_obs_scale"] * rotated(cube[3:], speed[3:]),  # a free joint turns in the cube's own frame
            env["goal_position"],
            positive(self.goal),
            positive(product(cube[3:], conjugate(self.goal))),
            *tips,
            self.previous_action,
            self.known,
        ]).astype(np.float32)

    def predict(self, hand, observation):
        """Returns what the policy sees of `hand`, whose model this is, if it acts on where the hand will be: the observation after the last
        targets. A prediction that diverges gives the observation as it is."""
        values, scale = observation.astype(float), self.env["vel_obs_scale"]
        angles, speeds, values = np.split(values, [len(self.angle), 2 * len(self.angle)])
        pose, linear, angular = values[:7], values[7:10], values[10:13] / scale
        qpos, qvel = self.model.qpos0.copy(), np.zeros(self.model.nv)
        qpos[self.angle], qvel[self.speed] = angles, speeds / scale
        qpos[self.cube:self.cube + 7] = pose
        qvel[self.cube_speed:self.cube_speed + 6] = *linear, *rotated(conjugate(pose[3:]), angular)
        self.place(qpos, qvel)
        for targets in hand.sent[-hand.env["prediction"]:]:
            self.move(targets)
        self.goal, self.previous_action = hand.goal, hand.previous_action
        bad = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]
        diverged = any(self.data.warning[kind].number for kind in bad)
        return observation if diverged else self.observe()

    def send(self, action):
        """Turns the action into smoothed targets, the newest ones that were sent."""
        self.previous_action = np.clip(action, -1, 1).astype(float)
        # In the order of the program's arithmetic: where contacts begin, a rounding error can grow.
        asked = self.low + (self.previous_action + 1) / 2 * (self.high - self.low)
        self.targets = np.clip(self.alpha * asked + (1 - self.alpha) * self.targets, self.low, self.high)
        self.sent = [*self.sent[1:], self.targets]

    def step(self, action):
        """Sends the targets of an action, and lets the physics run for one control step. With env.action_delay, targets take effect later."""
        self.send(action)
        self.move(self.sent[-1 - self.env["action_delay"]])

    def move(self, targets):
        """Lets the physics run for one control step under these targets."""
        self.data.ctrl[self.controls] = targets
        for _ in range(self.substeps):
            # mj_step in the other order, so that bodies and joints end at the same instant.
            mujoco.mj_step2(self.model, self.data)
            mujoco.mj_step1(self.model, self.data)

    def rotation_error(self):
        """Returns the angle between cube and goal, rad."""
        between = product(self.data.qpos[self.cube + 3:self.cube + 7], conjugate(self.goal))
        return 2 * np.arcsin(min(1.0, np.linalg.norm(between[1:])))

    def dropped(self):
        """Returns whether the cube is out of the hand."""
        return np.linalg.norm(self.data.qpos[self.cube:self.cube + 3] - self.env["goal_position"]) >= self.env["fall_dist"]


def frame(model, name):
    """Returns the kind and the number of the body or, if there is none, the site with this name."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    return (mujoco.mjtObj.mjOBJ_XBODY, body) if body >= 0 else (mujoco.mjtObj.mjOBJ_SITE, model.site(name).id)


def varied_model(env, scene, policy, drawn=None):
    """Compiles the scene with the physics that the settings ask for. Without changes, it is the scene itself. `drawn` is what an
    episode of a training has drawn on top of them: `randomization` in a dump."""
    drawn = drawn or {}
    factor = {key: env[key + "_scale"] * np.array(drawn.get(key, 1.0))
              for key in ("friction", "cube_mass", "hand_mass", "cube_size", "gains", "damping", "frictionloss")}
    offset = {key: np.array(env[key]) + drawn.get(key, [0, 0, 0]) for key in ("cube_com", "gravity")}
    spec = mujoco.MjSpec.from_file(str(scene))
    cube, size = spec.body(policy.facts["object_name"]), float(factor["cube_size"])
    if cube is None:
        raise KeyError(f"it has no body {policy.facts['object_name']}")
    if any(offset["cube_com"]):
        cube.simple = False  # MuJoCo's shortcut for bodies whose centre of mass is their origin
    if size != 1:
        if cube.bodies or cube.frames or any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in cube.geoms):
            sys.exit(f"error: {scene}: this program resizes only cubes of simple shapes")
        cube.ipos *= size
        cube.inertia *= size**2
        cube.fullinertia *= size**2
        for geom in cube.geoms:
            dimensions = 2 if geom.typeinertia == mujoco.mjtGeomInertia.mjINERTIA_SHELL else 3
            geom.size, geom.pos, geom.density = geom.size * size, geom.pos * size, geom.density / size**dimensions
            geom.fromto *= size
    model = spec.compile()
    model.opt.timestep = env["sim_dt"]
    model.opt.gravity += offset["gravity"]
    if env["cone"] != "scene":
        model.opt.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[env["cone"]]
    model.geom_friction[:] *= factor["friction"]
    model.pair_friction[:] *= factor["friction"]
    cube = model.body(policy.facts["object_name"])
    of_cube = model.body_rootid == cube.id
    tips = [frame(model, name) for name in policy.names("fingertip_names")]
    tips = [model.site_bodyid[tip] if kind == mujoco.mjtObj.mjOBJ_SITE else tip for kind, tip in tips]
    of_hand = np.isin(model.body_rootid, model.body_rootid[tips])
    for bodies, mass in (of_cube, factor["cube_mass"]), (of_hand, factor["hand_mass"]):
        model.body_mass[bodies] *= mass
        model.body_inertia[bodies] *= mass
    cube.ipos[:] += offset["cube_com"]
    servos = [model.actuator(name).id for name in policy.names("joint_names")]
    model.actuator_gainprm[servos, 0] *= factor["gains"]
    model.actuator_biasprm[servos, 1] *= factor["gains"]
    speeds = [model.joint(name).dofadr[0] for name in policy.names("hinge_names")]
    model.dof_damping[speeds] *= factor["damping"]
    model.dof_dampingpoly[speeds] *= factor["damping"][..., None] if factor["damping"].ndim else factor["damping"]
    model.dof_frictionloss[speeds] *= factor["frictionloss"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def product(a, b):
    """The quaternion product: first the rotation b, then a."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return np.array([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ])


def conjugate(q):
    return q * [1, -1, -1, -1]


def positive(q):
    """A quaternion and its negative are the same rotation. The policy sees the sign with w >= 0."""
    return -q if q[0] < 0 else q


def rotated(q, v):
    return product(product(q, np.array([0, *v])), conjugate(q))[1:]


def uniform_rotation(random):
    q = random.normal(size=4)
    return q / np.linalg.norm(q)


def play(policy, hand, model, episodes, seed):
    """Returns goals, length and whether the cube was dropped, for each episode. The policy acts on what the `model` predicts, if any."""
    env, played = hand.env, []
    for episode in range(episodes):
        random = np.random.default_rng([seed, episode])
        hand.reset(random)
        goals = held = steps = 0
        while steps < round(env["max_episode_seconds"] / env["ctrl_dt"]):
            observation = hand.observe()
            hand.step(policy.act(model.predict(hand, observation) if model else observation))
            steps += 1
            if hand.dropped():
                break
            if hand.rotation_error() <= env["success_tolerance"]:
                held += 1
            elif env["success_hold"] == "consecutive":
                held = 0
            if held >= env["max_consecutive_successes"]:
                goals, held, hand.goal = goals + 1, 0, uniform_rotation(random)
        played.append((goals, steps, hand.dropped()))
        print(f"\repisode {episode + 1} of {episodes}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return np.array(played, float)


def score(played):
    goals, lengths, drops = played.T
    interval = [None, None]  # one episode has none
    if len(goals) > 1:
        margin = 1.96 * goals.std(ddof=1) / len(goals) ** 0.5
        interval = [goals.mean() - margin, goals.mean() + margin]
    return {"episodes": len(goals), "goals_per_episode": goals.mean(), "goals_ci95": interval, "drop_rate": drops.mean(),
            "episode_length": lengths.mean()}


def check(policy, scene, model, trace):
    """Puts a hand into each state of a trace, and compares what is seen and done there. Returns whether all is alike. The world of the
    trace may have another physics than the `model` of the policy."""
    try:
        header, *records = [json.loads(line) for line in pathlib.Path(trace).read_text().splitlines()]
    except (OSError, ValueError) as error:
        sys.exit(f"error: {trace} is not a complete trace: {error}")
    if "sim_dt" not in header:
        sys.exit(f"error: {trace} does not begin with the header of a trace, so its task is not known")
    if not any(one["episode"] == other["episode"] for one, other in zip(records, records[1:])):
        sys.exit(f"error: {trace} has no two records of one episode, so there is nothing to compare")
    if header.get("noise") or header.get("bias"):
        sys.exit(f"error: {trace} was written with noise or bias, so its observations cannot be computed from its states")
    for key in sorted(header.keys() & model.env.keys() - {"model", *OF_WORLD}):
        if header[key] != model.env[key]:
            sys.exit(f"error: {trace} was written with env.{key} = {header[key]}, but the policy is exported for {model.env[key]}")
    for key, value in (header.get("predicted_with") or {}).items():
        if value != model.env[key]:
            sys.exit(f"error: {trace} was predicted with env.{key} = {value}, but the policy is exported for {model.env[key]}")
    hand = Hand(policy, scene, {key: header[key] for key in OF_WORLD if key in header})
    # A policy for the hand on the other side sees the mirror image of this one.
    mirror = np.eye(hand.size)
    if header.get("mirror_matrix"):
        rows, columns, values = np.array(header["mirror_matrix"]).T
        mirror = np.zeros_like(mirror)
        mirror[rows.astype(int), columns.astype(int)] = values
    largest, compared = [0.0, 0.0], 0
    for record, after in zip(records, records[1:] + [None]):
        if not all(np.isfinite(record[key]).all() for key in ("qpos", "qvel", "obs", "action") if key in record):
            sys.exit(f"error: {trace} has a value that is not finite")
        same = after is not None and after["episode"] == record["episode"]
        hand.place(record["qpos"], record["qvel"])
        # Where a goal was reached, the observation already shows the next one.
        hand.goal = np.array(after["goal"] if same else record["goal"])
        if record.get("reset"):
            hand.previous_action = np.zeros(len(hand.actuators))
            hand.start_targets()
        else:
            hand.send(np.array(record["action"]))
        observation, expected = hand.observe(), np.array(record["obs"])
        if hand.env["prediction"]:
            observation = model.predict(hand, observation)
        seen = observation @ mirror
        if not same:  # the goal after an episode's last step is in no record
            goal = slice(hand.goal_at, hand.goal_at + 8)
            seen[goal] = expected[goal]
        # Unlike max, this keeps a NaN.
        largest[0] = np.maximum(largest[0], np.abs(seen - expected).max())
        if same:
            action = policy.act(observation)
            largest[1] = np.maximum(largest[1], np.abs(action - np.clip(after["action"], -1, 1)).max())
            compared += 1
    print(f"{len(records)} observations: {largest[0]:.1e} off at most; {compared} actions: {largest[1]:.1e}")
    limit = ACTION_LIMIT if hand.env["prediction"] else OBSERVATION_LIMIT
    return largest[0] <= limit and largest[1] <= ACTION_LIMIT and compared > 0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--scene", default=SCENE, help="MJCF file (default: the program's)")
    parser.add_argument("--check", metavar="TRACE")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if args.episodes < 1:
        parser.error("--episodes must be at least 1")
    if args.seed < 0:
        parser.error("--seed must not be negative")
    with read_from(args.policy):
        policy = Policy(args.policy)
        hand = Hand(policy, args.scene)
        model = hand.model_of(policy, args.scene) if hand.env["prediction"] else None
    if args.check:
        with read_from(args.check):
            alike = check(policy, args.scene, model or hand, args.check)
        sys.exit(0 if alike else "error: too far off")
    with read_from(args.policy):
        found = score(play(policy, hand, model, args.episodes, args.seed))
    if args.json:
        print(json.dumps(found))
    else:
        low, high = found["goals_ci95"]
        interval = "" if low is None else f" ({low:.2f} … {high:.2f})"
        print(f"{found['goals_per_episode']:.2f} goals per episode{interval}, drops {100 * found['drop_rate']:.1f} %")


if __name__ == "__main__":
    main()
