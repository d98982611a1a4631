"""Many noisy paths at once, on all cores or many machines, and their statistics."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor

import numpy as np

from varpin.arrays import Floats
from varpin.ensemble.paths import Shared, without_geometry
from varpin.ensemble.record import Ensemble, EnsembleInterrupted
from varpin.ensemble.statistics import Sums
from varpin.errors import InputError, VarpinError
from varpin.finding import Finding, announce
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene, require_scene
from varpin.mechanics.wiener import children
from varpin.signals.controls import commands_of
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.simulation.choice import given_integrator, stronger, usual_integrator
from varpin.simulation.start import in_other_units, on_constraints, time_steps
from varpin.support.checks import (
    JointValues,
    as_floats,
    count,
    finite_array,
    flag,
    joint_array,
    require_finite,
    require_memory,
    told_motion,
)

logger = logging.getLogger(__name__)

# Paths on which the integrator is chosen: one of every _OF, at most _CHOOSING.
_OF, _CHOOSING = 16, 8


def simulate_ensemble(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    dt: float | None = None,
    steps: int | None = None,
    duration: float | None = None,
    paths: int,
    rng: np.random.Generator | int,
    controls: JointValues | LinearPolicy | OpenLoop | FirstOrderHold | None = None,
    integrator: Integrator | None = None,
    store: bool = True,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Ensemble:
    """Simulate many paths of a noisy scene.

    Path i draws its noise from the i-th child of ``rng``, and moments are merged in the order of the paths. The result
    is therefore the same, byte for byte, for any number of threads, processes or machines of one kind.

    Main args:
        scene: The scene. Noise that only Python evaluates (:class:`varpin.CustomNoise`) is slow.
        q0: Initial configuration, (n,) or by joint name for all paths, or (P, n) [rad or m].
        v0: Initial velocity, the same [rad/s or m/s].
        dt: Time step [s].
        steps: N, their number.
        duration: steps * dt [s]. Two of the three are given.
        paths: P.
        rng: Seed or generator.
        controls: None, (N, m), (m,), by joint name, :class:`OpenLoop`, :class:`FirstOrderHold`, or a
            :class:`LinearPolicy`, evaluated at the state of each path.

    Other Args:
        integrator: If left out, that of the policy of a plan under noise; else ``Midpoint(kick="held")``. In a scene
            without noise, the integrator that :func:`varpin.simulate` takes for a few of the paths.
            ``Ensemble.integrator`` says which.
        store: Keep every path. Otherwise only the statistics are kept, and memory does not grow with P N.
        quantiles: Levels in [0, 1]; with an empty list, workers return moments alone. Quantiles are of all paths if
            these are stored, or if P (N + 1) 2n is at most 33 million; otherwise of as many of the first paths,
            ``statistics.quantile_paths``.
        workers: Number of threads; if left out the number of cores, and one under a ``CustomNoise``.
        executor: Any ``concurrent.futures.Executor`` instead of threads: a ``ProcessPoolExecutor``, Dask's
            ``client.get_executor()``, an ``mpi4py.futures.MPIPoolExecutor``. It stays open. At most
            256 chunks of paths are submitted and not yet merged; together they return at most 2 GiB, unless two chunks
            alone return more.
        progress: Called with (paths done, P) after each chunk.

    Raises:
        InputError: Wrong shapes, or values that are not finite.
        ForceError, ConstraintError, NoiseError: A function of a :class:`varpin.CustomForce`,
            :class:`varpin.CustomConstraint` or :class:`varpin.CustomNoise` failed. The error names the path and holds
            its motion up to the failure.
        AssemblyError: No configuration near q0 satisfies the scene's constraints.
        VarpinError: Every path failed.
        WorkersLost: The executor has lost its workers; holds the finished paths.
        EnsembleInterrupted: Ctrl-C; holds the finished paths. It is a KeyboardInterrupt.
    """
    require_scene(scene)
    dt, steps = time_steps(dt, steps, duration)
    paths, store = count("paths", paths, least=1), flag("store", store)
    told_motion("progress", progress, "paths done, paths in all")
    _require_memory(scene, steps, paths, store=store)
    start = [_per_path(name, value, paths, scene.robot.joint_names) for name, value in (("q0", q0), ("v0", v0))]
    levels = require_finite("quantiles", as_floats("quantiles", quantiles))
    if levels.ndim != 1 or ((levels < 0.0) | (levels > 1.0)).any():
        raise InputError(f"quantiles must be levels in [0, 1], got {quantiles}")
    integrator = given_integrator(integrator, controls)
    if controls is None and (scene.servo_joints or scene.inputs):
        if (start[0] != start[0][0]).any():
            positions = "the scene has servos or inputs, and the paths begin at different positions"
            raise InputError(f"controls are needed: {positions}")
        controls = scene.command_at(start[0][0])
    start, moved = _onto_constraints(scene, start)
    if integrator is None:
        noisy = scene.processes > 0
        some = np.linspace(0, paths - 1, 1 if noisy else min(1 + paths // _OF, _CHOOSING)).astype(np.int64)
        integrator = stronger(usual_integrator(scene, start[0][j], start[1][j], dt, noisy=noisy) for j in some)
    commands = commands_of(scene, integrator, controls, steps, dt)
    shared = Shared(without_geometry(scene), integrator, commands, dt, steps, children(rng, paths))
    sums = Sums(shared, start[0], start[1], levels, store=store)
    found = sums.run(executor, workers, progress, EnsembleInterrupted)
    if len(sums.failures) == paths:
        raise VarpinError(sums.failing())
    found = (*in_other_units(scene, start[0][0], start[1][0]), *moved, *_alike(scene, start), *found)
    announce(logger, scene.announced, dt, found)
    return sums.result(found)


def _onto_constraints(scene: Scene, start: Sequence[Floats]) -> tuple[list[Floats], tuple[Finding, ...]]:
    """Initial states (P, n) projected onto the constraints, and the findings about the first path that was changed."""
    if not scene.constraints:
        return list(start), ()
    alike = all((x == x[0]).all() for x in start)
    starts = list(zip(*start, strict=True))[: 1 if alike else None]
    q, v, found = zip(*(on_constraints(scene, *own) for own in starts), strict=True)
    findings = ([finding.about(f"path {path}: " * (not alike)) for finding in own] for path, own in enumerate(found))
    moved = [np.broadcast_to(np.array(x), start[0].shape) for x in (q, v)]
    return moved, tuple(next((own for own in findings if own), []))


def _alike(scene: Scene, start: Sequence[Floats]) -> tuple[Finding, ...]:
    """A finding if all paths are the same motion."""
    if scene.processes or len(start[0]) < 2 or any((x != x[0]).any() for x in start):
        return ()
    sentence = (
        "the scene has no noise and all paths begin alike, so that they are one and the same motion: "
        "varpin.Scene(robot, noise=...) tells them apart"
    )
    return (Finding("paths alike", sentence),)


def _require_memory(scene: Scene, steps: int, paths: int, *, store: bool) -> None:
    """Refuse an ensemble whose record does not fit into memory."""
    n, m = scene.robot.dof, scene.controls
    stored = paths if store else 0
    row = 2 * n * (4 * n + 5) + m + stored * (3 * n + m + 1)
    require_memory(steps + 1, row, f"steps = {steps} with {stored} stored paths", "step")
    require_memory(paths, 2 * n, f"paths = {paths}", "path")


def _per_path(name: str, value: JointValues, paths: int, joints: Sequence[str]) -> Floats:
    n = len(joints)
    array = joint_array(name, value, joints) if isinstance(value, Mapping) else as_floats(name, value)
    if array.shape == (n,):
        return np.broadcast_to(finite_array(name, array, (n,)), (paths, n))
    return finite_array(name, array, (paths, n))
