"""Measures what physics settings cost and how close they stay to a converged reference with a timestep of 0.002 s.

Usage: python fidelity.py [--rollouts 1000] [--hold 1] [--only NAME ...] [--list]
Needs: numpy, mujoco==3.17.0. Runs from any folder. Keep the machine idle. Takes about ten minutes on two cores.

Each variant is the project's scene with one change. All variants play the same rollouts of 1 s from the task's start states,
with actions drawn as a new policy draws them (Gaussian, standard deviation 0.5, a new one every 0.01 s). With `--hold 30` each
action is held for 0.3 s and drawn with standard deviation 1, so that whole poses are reached. Per variant:
- speed:  control steps/s relative to the default, median of rounds run in turn
- apart:  distance between the cube and its position in the reference after 1 s, median and 90th percentile. Contacts are chaotic,
          so the row `reference, moved 1 nm` shows the distance that remains with identical settings
- lost:   rollouts in which the cube ends 0.24 m or more from the goal position, and in parentheses the diverged ones
- deep:   depth of the deepest contact of the cube and within the hand, computed with all contact pairs, mean over states
- energy: kinetic energy of the hand and of the cube, mean over states
"""
import argparse
import os
import pathlib
import statistics
import time

import mujoco
import numpy as np
from mujoco import rollout

SCENE = pathlib.Path(__file__).resolve().parents[2] / "assets/shadow_hand/scene.xml"
GOAL = np.array([0.33, 0.0, 0.295])
CONTROL_STEPS, CONTROL_DT = 100, 0.01


def build(change=None, dt=0.01):
    spec = mujoco.MjSpec.from_file(str(SCENE))
    if change:
        change(spec)
    model = spec.compile()
    model.opt.timestep = dt
    return model


def converged(spec):
    spec.option.iterations, spec.option.tolerance = 200, 1e-12
    spec.option.ls_iterations, spec.option.ls_tolerance = 100, 1e-6


def option(**values):
    def change(spec):
        for name, value in values.items():
            setattr(spec.option, name, value)
    return change


def disable(flag):
    def change(spec):
        spec.option.disableflags |= flag
    return change


def armature(value):
    def change(spec):
        for joint in spec.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
                joint.armature = value
    return change


BASE = {"rh_forearm", "rh_wrist", "rh_palm", "rh_lfmetacarpal", "rh_thbase",
        "rh_ffknuckle", "rh_mfknuckle", "rh_rfknuckle", "rh_lfknuckle"}


def base_apart(spec):
    """The base of the hand touches neither itself nor the proximal parts of the fingers."""
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            proximal = geom.parent.name.endswith("proximal")
            geom.contype, geom.conaffinity = (1, 0) if geom.parent.name in BASE else (2, 2) if proximal else (2, 3)


def no_contacts_in_the_hand(spec):
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = (1, 1) if geom.name == "cube" else (1, 0)


def islands(spec):
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


VARIANTS = {
    "default": build,
    "with islands": lambda: build(islands),
    "base and proximal parts apart": lambda: build(base_apart),
    "no contacts in the hand": lambda: build(no_contacts_in_the_hand),
    "iterations 100": lambda: build(option(iterations=100)),
    "iterations 5": lambda: build(option(iterations=5)),
    "iterations 3": lambda: build(option(iterations=3)),
    "tolerance 1e-8": lambda: build(option(tolerance=1e-8)),
    "tolerance 1e-4": lambda: build(option(tolerance=1e-4)),
    "tolerance 1e-3": lambda: build(option(tolerance=1e-3)),
    "line search of 5 steps": lambda: build(option(ls_iterations=5)),
    "conjugate gradients": lambda: build(option(solver=mujoco.mjtSolver.mjSOL_CG)),
    "sparse": lambda: build(option(jacobian=mujoco.mjtJacobian.mjJAC_SPARSE)),
    "no midphase": lambda: build(disable(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)),
    "elliptic cone": lambda: build(option(cone=mujoco.mjtCone.mjCONE_ELLIPTIC)),
    "impratio 1": lambda: build(option(impratio=1)),
    "armature 0.0002": lambda: build(armature(0.0002)),
    "armature 0.001": lambda: build(armature(0.001)),
    "armature 0.005": lambda: build(armature(0.005)),
    "timestep 0.005": lambda: build(dt=0.005),
    "timestep 0.002": lambda: build(dt=0.002),
    "converged": lambda: build(converged),
}


class Starts:
    """The start states and actions of all rollouts."""

    def __init__(self, model, count, rng, hold):
        hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
        at, limits = model.jnt_qposadr[hinges], model.jnt_range[hinges]
        cube = model.jnt_qposadr[model.body("cube").jntadr[0]]
        qpos = np.tile(model.qpos0, (count, 1))
        qpos[:, at] = np.clip(qpos[:, at] + rng.uniform(-0.2, 0.2, (count, len(at))), *limits.T)
        qpos[:, cube:cube + 3] = GOAL + rng.uniform(-0.01, 0.01, (count, 3))
        turn = rng.normal(size=(count, 4))
        qpos[:, cube + 3:cube + 7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.states = np.zeros((count, size))
        self.states[:, 1:1 + model.nq] = qpos
        low, high = model.actuator_ctrlrange.T
        # Held actions have a larger deviation, so that fingers press against one another at the ends of their ranges.
        deviation = 0.5 if hold == 1 else 1.0
        action = np.clip(rng.normal(0, deviation, (count, -(-CONTROL_STEPS // hold), model.nu)), -1, 1)
        action = np.repeat(action, hold, axis=1)[:, :CONTROL_STEPS]
        self.controls = low + (action + 1) / 2 * (high - low)
        self.cube, self.nq = slice(1 + cube, 4 + cube), model.nq


def play(pool, model, datas, starts, states=None):
    substeps = round(CONTROL_DT / model.opt.timestep)
    controls = np.repeat(starts.controls, substeps, axis=1)
    start = time.perf_counter()
    trajectory, _ = pool.rollout(model, datas, starts.states if states is None else states, control=controls)
    seconds = time.perf_counter() - start
    return np.asarray(trajectory)[:, substeps - 1::substeps], seconds


def contacts_and_energy(judge, starts, trajectory):
    """Returns the mean depth (mm) of the deepest contact of the cube and within the hand, and the mean kinetic energies (mJ)."""
    data, cube = mujoco.MjData(judge), judge.geom("cube").id
    cube_dof = judge.jnt_dofadr[judge.body("cube").jntadr[0]]
    depths, energies = [], []
    for states in trajectory[:, 9::10]:
        for state in states:
            mujoco.mj_setState(judge, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            mujoco.mj_fwdPosition(judge, data)
            contact = data.contact
            of_cube = (contact.geom == cube).any(1)
            depths.append([max(0.0, -contact.dist[which].min()) if which.any() else 0.0 for which in (of_cube, ~of_cube)])
            momentum = np.zeros(judge.nv)
            mujoco.mj_mulM(judge, data, momentum, data.qvel)
            energy = 0.5 * data.qvel * momentum
            of_cube = slice(cube_dof, cube_dof + 6)
            energies.append([energy.sum() - energy[of_cube].sum(), energy[of_cube].sum()])
    return 1e3 * np.mean(depths, 0), 1e3 * np.mean(energies, 0)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--rollouts", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--hold", type=int, default=1, help="control steps for which an action is held")
    parser.add_argument("--only", nargs="*", help="variants to run in addition to the default")
    parser.add_argument("--list", action="store_true")
    args = parser.parse_args()
    mujoco.set_mju_user_warning(lambda message: None)  # MuJoCo warns of diverging states, which are counted here
    if args.list:
        print("\n".join(VARIANTS))
        return
    names = ["default", *(n for n in (args.only or VARIANTS) if n != "default")]
    reference = build(converged, dt=0.002)
    starts = Starts(reference, args.rollouts, np.random.default_rng(0), args.hold)
    with rollout.Rollout(nthread=args.threads) as pool:
        def run(model, states=None):
            return play(pool, model, [mujoco.MjData(model) for _ in range(args.threads)], starts, states)

        truth, _ = run(reference)
        moved = starts.states.copy()
        moved[:, starts.cube.start] += 1e-9
        results = {"reference": (truth, None), "reference, moved 1 nm": (run(reference, moved)[0], None)}
        models = {name: VARIANTS[name]() for name in names}
        seconds = {name: [] for name in names}
        for _ in range(args.rounds):
            for name, model in models.items():
                trajectory, taken = run(model)
                seconds[name].append(taken)
                results[name] = (trajectory, name)
    print(f"{args.rollouts} rollouts of 1 s, {args.threads} threads, default "
          f"{args.rollouts * CONTROL_STEPS / statistics.median(seconds['default']):.0f} control steps/s")
    print("| variant | speed | apart, mm: median, 90 % | lost | deep, mm: cube, hand | kinetic energy, mJ: hand, cube |")
    print("|---|---|---|---|---|---|")
    for name, (trajectory, timed) in results.items():
        speed = "–"
        if timed:
            speed = f"{statistics.median(d / s for d, s in zip(seconds['default'], seconds[name])):.2f}"
        end = trajectory[:, -1, starts.cube]
        apart = 1e3 * np.linalg.norm(end - truth[:, -1, starts.cube], axis=1)
        lost = (np.linalg.norm(end - GOAL, axis=1) >= 0.24).mean()
        # MuJoCo resets a diverged state, including its time.
        diverged = (trajectory[:, -1, 0] < CONTROL_STEPS * CONTROL_DT - 1e-6).mean()
        depth, energy = contacts_and_energy(reference, starts, trajectory)
        print(f"| {name} | {speed} | {np.median(apart):.1f}, {np.percentile(apart, 90):.1f} | {100 * lost:.1f} ({100 * diverged:.1f}) % "
              f"| {depth[0]:.2f}, {depth[1]:.2f} | {energy[0]:.1f}, {energy[1]:.2f} |", flush=True)


if __name__ == "__main__":
    main()
