"""The core's border to Python: an array that does not fit is refused, whichever it is and along whichever axis.

Below the border nothing is checked. Run on a build with sanitizers, as ``.ci/thorough`` does, the calls that fit are
held against reading and writing past an array's end, too.
"""

import threading

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import built
from refusals import refused

import varpin as vp
from varpin import core
from varpin.core.arrays import Commands, ConstraintRows, Diffusion, RolloutArrays, Tree, new_nodes
from varpin.integrators.tableau import gauss_coefficients, lobatto_places
from varpin.signals.commands import interpolation, open_loop

N, P = 4, 2
NOISE = vp.AdditiveNoise(1e-3) + vp.ControlNoise(0.1) + vp.StateNoise(0.1)
OF_BODIES = Tree._fields[: Tree._fields.index("loads")]
GUARDS = {"active": True, "branch_margin": 0.5, "energy_balance": 5e-3, "energy_budget": 0.02, "most_halvings": 12}


def draw(*shape):
    return np.random.default_rng(shape).normal(size=shape)


def scene():
    return vp.Scene(vp.load_robot("panda"), damping=0.1, noise=NOISE, actuation=draw(8, 3))


def fields_of(prefix, record):
    return {f"{prefix}.{name}": value for name, value in record._asdict().items()}


def record(kind, prefix, parts):
    return kind(**{name: parts[f"{prefix}.{name}"] for name in kind._fields})


def of_mechanism(scene):
    return {
        **fields_of("tree", scene.robot.tree),
        **fields_of("diffusion", scene.noise.arrays),
        **{name: getattr(scene, name) for name in ("gravity", "actuation")},
        "forces": scene.elements,
        "couplings": scene.couplings,
        "constraints": scene.bound_constraints.rows,
        "custom": scene.custom,
    }


def mechanism(**parts):
    others = {name: value for name, value in parts.items() if "." not in name}
    return core.Mechanism.make(record(Tree, "tree", parts), diffusion=record(Diffusion, "diffusion", parts), **others)


def of_tableau():
    a, b, c = gauss_coefficients(2)
    ahead = interpolation(np.append(c, 1.0), 1.0 + c)
    return {"a": a, "gradient": a, "force": a, "b": b, "c": c, "ahead": ahead, "reach": 0.1, "skew": 0.0} | {
        "stiffly_accurate": False
    }


def of_roll(scene, feedback):
    n, m, k = scene.robot.dof, scene.controls, scene.processes
    width = {"none": 2 * n, "state": 2 * n, "state and control": 2 * n + m}[feedback]
    rows = 0 if feedback == "none" else N // 2
    limits = np.array([[-1.0] * m, [1.0] * m])
    commands = Commands(draw(N // 2, m), draw(rows, m, width), draw(rows, width), 2, limits, draw(P, m))
    nodes = new_nodes(P, N, n, m)
    return {
        **fields_of("commands", commands),
        **fields_of("nodes", nodes),
        "dt": 1e-3,
        "increments": 1e-2 * draw(P, N, k),
        "drift": draw(P, N, n),
    }


def roll(rollout):
    def call(dt, increments, drift, **parts):
        commands, nodes = record(Commands, "commands", parts), record(RolloutArrays, "nodes", parts)
        path = rollout.copy() if isinstance(rollout, core.ExplicitRollout) else rollout.fork(core.Guards.make(**GUARDS))
        path.roll(dt, commands, increments, drift, nodes)
        assert (nodes.done == N).all()
        assert np.isfinite(nodes.q).all()

    return call


def variational(scene):
    tableau, guards = core.Tableau.make(**of_tableau()), core.Guards.make(**GUARDS)
    return core.Rollout(scene.core, tableau, 0.5, guards, 0.5, P)


def constrained(scene):
    tableau, guards = core.Tableau.make(**of_tableau()), core.Guards.make(**GUARDS)
    return core.Rollout(scene.core, tableau, 0.5, guards, 1.0, P, places=lobatto_places(2))


def explicit(scene, method):
    n = scene.robot.dof
    return core.ExplicitRollout.start(scene.core, method, draw(P, n), draw(P, n))


def begun(scene):
    rollout, n = variational(scene), scene.robot.dof
    assert rollout.begin(draw(P, n), draw(P, n))
    return rollout


def steps(scene):
    n = scene.robot.dof
    return {
        "mechanism": scene.core,
        "tableau": core.Tableau.make(**of_tableau()),
        "tolerance": 0.5,
        "guards": core.Guards.make(**GUARDS),
        "dt": 1e-3,
        **{"q": draw(N, n), "p": 0.1 * draw(N, n), "force": draw(N, 1, n)},
        "substeps": np.array([1, 1, 2, 4]),
        "halvings": np.array([1, 1, 2, 2, 2, 2], dtype=np.uint8),
        "guess": np.zeros((N, 2, n)),
    }


def cost_terms(links, n, m):
    costs = core.CostTerms.make(n, m)
    frame, center = costs.add_frame(links, np.eye(3), draw(3)), costs.add_center(links)
    none, subject = np.zeros(0, dtype=np.int64), core.Subject
    costs.add_term(subject.entries, 2 * n, np.eye(m), draw(N, m), none)
    costs.add_term(subject.excess, n, np.eye(n), np.tile([-0.1, 0.1], (1, n)), none)
    costs.add_term(subject.position, frame, np.eye(3), draw(N, 3), none)
    costs.add_term(subject.orientation, frame, np.eye(3), np.eye(3).reshape(1, 9), none)
    costs.add_term(subject.twist, frame, np.eye(6), draw(2, 6), none)
    costs.add_term(subject.manipulability, frame, np.eye(1), np.ones((1, 1)), np.arange(6))
    costs.add_term(subject.position, center, np.eye(3), draw(1, 3), none)
    return costs


def of_backward(n, m, k=2):
    x, R = 2 * n, N // 2
    given = {"A": draw(N, x, x), "B": draw(N, x, m), "G": draw(N, x, k), "Gx": draw(N, x, k, x), "Gu": draw(N, x, k, m)}
    given |= {"gradient": draw(N, x + m), "hessian": np.tile(np.eye(x + m), (N, 1, 1)), "end": draw(x)}
    written = {"feedforward": (R, m), "feedback": (R, m, x), "control_gradient": (R, m)}
    written |= {"spread": (N, x, x), "factors": (R, m, m)}
    return given | {name: np.empty(shape) for name, shape in written.items()}


def backward(end, **arrays):
    run = core.BackwardPass(arrays["B"].shape[2], end, np.eye(end.size))
    assert run.run(1e-3, 2, 0.0, **arrays) == -1


def calls():
    own = scene()
    n, m = own.robot.dof, own.controls
    state, states = {"q": draw(n), "v": draw(n)}, {"q": draw(N, n), "v": draw(N, n)}
    tree = own.robot.tree
    made = core.Links.make(tree)
    many = {**states, "force": draw(N, n)}
    dynamics = core.ForwardDynamics(own.core)
    yield "mechanism", mechanism, of_mechanism(own)
    yield "jet", own.core.jet, state
    yield "jets", own.core.jets, states
    yield "jets along", own.core.jets_along, {**states, "alpha": draw(N, n), "beta": draw(N, n)}
    yield "tableau", core.Tableau.make, of_tableau()
    yield "begin", variational(own).begin, {"q": draw(P, n), "v": draw(P, n)}
    nodes = fields_of("nodes", new_nodes(P, 1, n, m))
    yield "first nodes", lambda **parts: begun(own).first_nodes(record(RolloutArrays, "nodes", parts)), nodes
    for feedback in ("none", "state", "state and control"):
        yield f"roll, feedback of {feedback}", roll(begun(own)), of_roll(own, feedback)
        for method in core.ExplicitMethod:
            yield f"{method}, feedback of {feedback}", roll(explicit(own, method)), of_roll(own, feedback)
    yield "steps", core.Steps, steps(own)
    yield "curvatures", core.Steps(**steps(own)).curvatures, {"z": draw(N, 2 * n)}
    yield "inverse dynamics", core.inverse_dynamics, {"mechanism": own.core, **states, "a": draw(N, n)}
    yield "accelerations", core.accelerations, {"mechanism": own.core, **many}
    for method in core.ExplicitMethod:
        fixed = {"mechanism": own.core, "method": method, "dt": 1e-3}
        yield f"derivatives of {method}", core.linearize_explicit, {**fixed, **states, "force": draw(N, 1, n)}
    closed = vp.Scene(own.robot, constraints=vp.PointOnPoint("panda_hand", (0.3, 0.0, 0.5)))
    yield "constraints", closed.core.constraints, {"q": draw(N, n)}
    at = {"q": draw(n), "weights": draw(3), "v": draw(n)}
    yield "curvature of constraints", closed.core.constraint_curvature, at
    yield "begin under constraints", constrained(closed).begin, {"q": draw(P, n), "v": draw(P, n)}
    moved = vp.Scene(own.robot, constraints=vp.KinematicInput(own.robot.joint_names[0], "cubic"))
    again = {"rates": draw(N, 1), "places": lobatto_places(2)}
    yield "derivatives under constraints", core.Steps(**steps(moved)).derivatives, again
    yield "rate", dynamics.rate, {"x": draw(2 * n), "force": draw(n)}
    yield "node", dynamics.node, {"x": draw(2 * n)}
    bodies = {name: getattr(tree, name) for name in OF_BODIES}
    yield "links", lambda **parts: core.Links.make(tree._replace(**parts)), bodies
    frame = {"turned": np.eye(3), "shifted": draw(3), "q": draw(N, n), "jacobian": True}
    yield "place a frame", made.place_frame, frame
    yield "backward pass", backward, of_backward(n, m)
    costs = cost_terms(made, n, m)
    for name, call in (("cost values", costs.values), ("cost expansions", costs.expand)):
        yield name, call, {**states, "u": draw(N, m)}


# Sizes that are the caller's to choose: rows of what is done one by one.
# Of two stages: a force for each.
FREE = {("place a frame", "q", 0), ("constraints", "q", 0), ("steps", "force", 1)}


@pytest.fixture(scope="module")
def every():
    return list(calls())


def test_what_fits_is_taken(every):
    for _, call, arguments in every:
        call(**arguments)


def sized_otherwise(name, arguments, change):
    """Arguments of which one array is larger or smaller along one axis; what is left out, or free, is as it is."""
    for argument, value in arguments.items():
        if not isinstance(value, np.ndarray) or value.size == 0:
            continue
        for axis in range(value.ndim):
            shape = [size + change * (i == axis) for i, size in enumerate(value.shape)]
            if (name, argument, axis) not in FREE:
                yield f"{name}: {argument} of shape {shape}", {**arguments, argument: np.resize(value, shape)}


@pytest.mark.parametrize("change", [-1, 1])
def test_what_does_not_fit_is_refused(every, change):
    taken = []
    for name, call, fitting in every:
        for what, arguments in sized_otherwise(name, fitting, change):
            try:
                call(**arguments)
            except ValueError:
                continue
            taken.append(what)
    assert taken == []


def with_rate(rate):
    own = vp.Scene(vp.planar_chain(1), constraints=vp.KinematicInput("joint1"))
    rows = own.bound_constraints.rows
    rows = rows._replace(ties=tuple(tie._replace(rate=rate) for tie in rows.ties))
    return mechanism(**of_mechanism(own) | {"constraints": rows})


def with_level(level):
    halvings = np.array([1, 1, 2, 2, 2, level], dtype=np.uint8)
    return core.Steps(**{**steps(scene()), "halvings": halvings})


@pytest.mark.parametrize(
    ("make", "values", "facts"),
    [
        (lambda most: core.Guards.make(**{**GUARDS, "most_halvings": most}), (-1, 63), ("halvings", "62")),
        (with_rate, (-2, 1), "control"),
        (with_level, (0, 63), ("halvings", "62")),
    ],
)
def test_numbers_that_cannot_be_are_refused(make, values, facts):
    for value in values:
        with refused(ValueError, facts):
            make(value)


@pytest.mark.parametrize("path", [-1, P])
def test_parts_of_a_path_that_is_not_there_are_refused(path):
    with pytest.raises((ValueError, TypeError), match=r"no such path|incompatible"):
        begun(scene()).halvings(path)


def test_two_threads_in_forks_of_one_rollout_are_refused():
    """Forks share the work arrays of a step."""
    own = vp.Scene(vp.planar_chain(3))
    rollout = core.Rollout(own.core, core.Tableau.make(**of_tableau()), 0.5, core.Guards.make(**GUARDS), 1.0, 1)
    assert rollout.begin(np.zeros((1, 3)), np.zeros((1, 3)))
    other, nodes = rollout.fork(core.Guards.make(**GUARDS)), new_nodes(1, 50_000, 3, 3)
    nothing = np.zeros((0, 0, 0)), np.zeros((0, 0, 3))
    one = 1e-3, open_loop(np.zeros((1, 3))), *nothing, new_nodes(1, 1, 3, 3)
    thread = threading.Thread(target=rollout.roll, args=(1e-3, open_loop(np.zeros((50_000, 3))), *nothing, nodes))
    thread.start()
    with refused(RuntimeError, "two threads"):
        while thread.is_alive():
            other.roll(*one)
    thread.join()
    assert nodes.done == 50_000
    other.roll(*one)


@pytest.mark.parametrize(
    ("field", "value", "facts"),
    [
        ("parent", [-1, 1], "parents"),
        ("coordinate", [0, 2], "coordinate"),
        ("group", [0, 3], "group"),
        ("mass", [1.0], ("mass", "1")),
        ("ends", [1], "block"),
        ("ends", [3], "blocks"),
        ("loads", [0], ("carried", "0", "1")),
    ],
)
def test_what_is_no_tree_is_refused(field, value, facts):
    own = of_mechanism(vp.Scene(vp.planar_chain(2)))
    own[f"tree.{field}"] = np.array(value, dtype=np.asarray(own[f"tree.{field}"]).dtype)
    with refused(ValueError, facts):
        mechanism(**own)


@pytest.mark.parametrize("method", core.ExplicitMethod)
def test_where_a_mass_matrix_is_singular(method):
    """Of a point mass on a slider that turns: it has no inertia about the axis where it stands on it."""
    point = pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3)))
    scene = vp.Scene(built((pin.JointModelRZ(), [0, 0, 0], None), (pin.JointModelPX(), [0.5, 0, 0], point)))
    at = np.array([[0.0, 1.0], [0.0, 2.0], [0.0, -0.5], [0.0, 1.0]])
    nothing = np.zeros_like(at)
    assert core.accelerations(scene.core, at, nothing, nothing)[-1] == 2
    assert core.linearize_explicit(scene.core, method, 1e-3, at, nothing, nothing[:, None])[-1] == 2
    nodes = new_nodes(4, 3, 2, 2)
    assert not core.ExplicitRollout.start(scene.core, method, at, nothing).first_nodes(nodes)
    core.ExplicitRollout.start(scene.core, method, at, nothing).roll(
        1e-3, open_loop(np.zeros((3, 2))), np.zeros((0, 0, 0)), np.zeros((0, 0, 2)), nodes
    )
    assert nodes.done.tolist() == [3, 3, 0, 3]
    ends = core.Outcome.solved, core.Outcome.singular
    assert nodes.ended.tolist() == [ends[0], ends[0], ends[1], ends[0]]


@pytest.mark.parametrize(
    ("change", "error", "facts"),
    [
        ({"q": np.zeros((3, 4, 2))[:, :, ::-1]}, TypeError, "q"),
        ({"done": np.zeros(3, dtype=np.int32)}, TypeError, "done"),
        ({"hold": 0}, ValueError, "steps"),
        ({"gains": np.zeros((4, 2, 3))}, ValueError, "column"),
    ],
)
def test_what_no_rollout_takes_is_refused(change, error, facts):
    still, nothing = np.zeros((3, 2)), (np.zeros((0, 0, 0)), np.zeros((0, 0, 2)))
    commands, nodes = open_loop(np.zeros((4, 2))), new_nodes(3, 4, 2, 2)
    scene = vp.Scene(vp.planar_chain(2))
    rollout = core.ExplicitRollout.start(scene.core, core.ExplicitMethod.euler, still, still)
    rollout.roll(1e-2, commands, *nothing, nodes)
    if change.keys() <= {"q", "done"}:
        nodes = nodes._replace(**change)
    else:
        commands = commands._replace(**change)
    with refused(error, facts):
        rollout.roll(1e-2, commands, *nothing, nodes)


def test_matrices_beyond_the_range_of_indices_are_refused_before_there_is_room_for_them():
    """A chain of 50 000 joints has mass matrices of more than 2^31 numbers; what needs none of them runs."""
    n, link = 50_000, vp.planar_chain(1).tree
    own = {name: np.repeat(getattr(link, name), n, axis=0) for name in (
        "prismatic", "rotation", "translation", "mass", "center", "inertia", "ratio", "offset", "periodic", "armature",
        "group",
    )}  # fmt: skip
    own |= {"parent": np.arange(-1, n - 1), "coordinate": np.arange(n), "origin": np.repeat([1, 0], [1, n - 1])}
    own |= {"loads": np.zeros(0, dtype=np.int64), "carried": np.zeros((0, n), dtype=np.int64), "ends": np.array([n])}
    none = np.zeros((n, 0))
    chain = core.Mechanism.make(
        Tree(**own, groups=1),
        gravity=np.zeros(3),
        forces=[],
        couplings=[],
        constraints=ConstraintRows(),
        custom=None,
        actuation=none,
        diffusion=Diffusion(none, np.zeros((n, 0, 0)), none, none),
    )
    still = np.zeros((1, n))
    step = (vp.Midpoint().scheme.tableau, 0.5, vp.Midpoint()._guards(vp.Guard()))
    assert core.Rollout(chain, *step, 1.0, 1).begin(still, still)
    with refused(ValueError, "matrix"):
        core.Rollout(chain, vp.Gauss(2).scheme.tableau, *step[1:], 1.0, 1)
    with refused(ValueError, "matrix"):
        chain.jet(still[0], still[0])
