"""What a notebook shows of an object: its numbers, no markup but ours, and never a wall of them."""

import html
import itertools
from html.parser import HTMLParser

import numpy as np
import pytest
from mechanisms import joint, link, write_urdf

import varpin as vp
from varpin.support.markup import listed, table

NAMES = ("<script>alert(1)</script>", 'a" onmouseover="x', "b & <b>c</b>")
TAGS = {"div", "b", "table", "thead", "tbody", "tr", "th", "td", "details", "summary"}


class Reader(HTMLParser):
    """Tables as rows of texts; complains of what is not closed, and of what is not ours."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.rows, self.text = [], [], ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        assert tag in TAGS
        assert {name for name, _ in attrs} <= {"style", "class", "colspan"}
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def row(shown, *begin):
    (found,) = [cells for cells in Reader(shown).rows if tuple(cells[: len(begin)]) == begin]
    return found[len(begin) :]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """Three links in a row, whose joints and links have names that are markup."""
    folder, names = tmp_path_factory.mktemp("arm"), [html.escape(name) for name in NAMES]
    links = ["base", *(f"link {name}" for name in names)]
    joints = [joint(name, *pair) for name, pair in zip(names, itertools.pairwise(links), strict=True)]
    path = write_urdf(folder, *map(link, links[1:]), *joints)
    return vp.load_robot(path.rename(folder / "a<i>rm.urdf"))


@pytest.fixture(scope="module")
def objects(robot):
    scene = vp.Scene(robot, damping=0.2, noise=vp.AdditiveNoise(0.01))
    motion = vp.simulate(scene, [0.1, 0.2, 0.3], np.zeros(3), dt=5e-3, steps=40, increments=0)
    lin = vp.linearize(scene, motion)
    cost = vp.TrackingCost(np.zeros(3), 1.0) + vp.ControlCost(1e-2) + vp.Terminal(vp.VelocityCost(2.0))
    problem = vp.OptimalControlProblem(scene, cost, [0.1, 0.2, 0.3], np.zeros(3), dt=5e-3, steps=40)
    plan, file = vp.solve(problem), vp.load_scene("allegro_finger")
    choice = vp.Choice(vp.Gauss(stages=2), 0.02, 50, 1e-6, 2e-3, True)
    other = vp.Choice(vp.Midpoint(), 0.01, 100, np.inf, 1e-3, False)
    advice = vp.Advice((choice, other), "arm", True, 1e-5, None, 0.1, "Take <Gauss>.\nIt is enough.")
    runs = [
        vp.WorkPrecisionRun(f"{NAMES[0]} {k}", 2, 0.01 * k, 10, 1.0 / k, 0.1 * k, np.nan, 1, 1, 1, 0) for k in (1, 2)
    ]
    return {
        "robot": robot,
        "scene": scene,
        "motion": motion,
        "linearization": lin,
        "curvature": vp.second_order(scene, motion, np.ones(6)),
        "moments": vp.propagate_moments(lin),
        "ensemble": vp.simulate_ensemble(scene, np.zeros(3), np.zeros(3), dt=5e-3, steps=20, paths=8, rng=0),
        "cost": cost,
        "problem": problem,
        "plan": plan,
        "verification": plan.verify(),
        "monte carlo": plan.monte_carlo(paths=8, rng=0),
        "mpc": vp.Mpc(problem),
        "run": vp.Mpc(problem).run(duration=0.02),
        "file": file,
        "required": file.required,
        "report": vp.inspect_robot(robot),
        "advice": advice,
        "precision": vp.WorkPrecision(tuple(runs), "arm", 1.0, "Reference()", 1e-12, 4),
    }


def test_no_name_becomes_markup(objects):
    shown = {name: thing._repr_html_() for name, thing in objects.items() if hasattr(thing, "_repr_html_")}
    for text in shown.values():
        Reader(text)
    for name in ("robot", "scene", "motion", "mpc", "report", "plan"):
        assert "a<i>rm" in Reader(shown[name]).text
    for name in ("robot", "scene", "motion", "report"):
        assert all(one in Reader(shown[name]).text for one in NAMES)
    assert NAMES[0] in Reader(shown["precision"]).text
    assert "Take <Gauss>." in Reader(shown["advice"]).text
    assert row(shown["verification"], "planned")[0] == f"{objects['verification'].planned_cost:.6e}"
    assert row(shown["verification"], "", "cost") == ["loss", "end off by [rad or m]"]


def test_a_repr_is_a_line_without_arrays(objects):
    others = [objects["ensemble"].statistics, objects["plan"].search]
    for thing in [*(objects[name] for name in objects if name not in ("verification", "required")), *others]:
        assert "\n" not in repr(thing)
        assert "array(" not in repr(thing)
        assert len(repr(thing)) < 400, type(thing)


def test_motions_show_where_they_went(objects):
    motion = objects["motion"]
    shown = motion._repr_html_()
    for k, name in enumerate(NAMES):
        q, v = motion.q[:, k], motion.v[:, k]
        numbers = [q[0], q[-1], q.min(), q.max(), np.abs(v).max()]
        assert row(shown, name) == [f"{number:.4g}" for number in numbers]
    ensemble, end = objects["ensemble"], objects["ensemble"].q[:, -1]
    for k, name in enumerate(NAMES):
        numbers = [end[:, k].mean(), end[:, k].std(ddof=1)]
        assert row(ensemble._repr_html_(), name) == [f"{number:.4g}" for number in numbers]
    lost = np.abs(motion.energy - motion.energy[0]).max()
    assert row(shown, "energy change")[0].endswith(f", {lost:.3g} J at most in between")
    assert "warning" not in Reader(shown).text


def test_plans_show_how_the_search_went(objects):
    plan = objects["plan"]
    shown = plan._repr_html_()
    assert row(shown, "status") == ["converged"]
    assert row(shown, "cost") == [f"{plan.cost:.6g}, and {plan.noise_cost:.4g} by noise"]
    rows = Reader(shown).rows
    (head,) = [k for k, cells in enumerate(rows) if "expected" in cells]
    assert [cells[:2] for cells in rows[head + 1 :]] == [[str(x.index), f"{x.cost:.6e}"] for x in plan.history]


def test_the_best_is_bold(objects):
    assert "<b>Gauss(stages=2)" in objects["advice"]._repr_html_()
    assert "<b>0.02</b>" in objects["precision"]._repr_html_()
    assert "nan" not in objects["precision"]._repr_html_()


def test_tables_say_how_much_they_leave_out():
    shown = table(("joint",), [(f"joint{k}",) for k in range(120)])
    assert Reader(shown).rows[-1] == ["and 70 more"]
    assert len(Reader(shown).rows) == 52
    assert listed(range(60)).endswith("48, 49 and 10 more")
    assert listed([]) == "none"
    assert len(vp.planar_chain(60)._repr_html_()) < 20_000
