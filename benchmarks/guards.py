"""Prints energy errors of an undamped planar chain at coarse steps, and what the guards of the midpoint step cost.

python benchmarks/guards.py
"""

import logging

import numpy as np

import varpin as vp

DURATION = 1000.0


def row(links: int, dt: float) -> str:
    """One chain at one step, as a row of a Markdown table."""
    steps = round(DURATION / dt)
    scene, rest = vp.Scene(vp.planar_chain(links)), np.zeros(links)
    motion = vp.simulate(scene, rest, rest, dt=dt, steps=steps, integrator=vp.Midpoint(), check=False)
    error = (motion.energy - motion.energy[0]) / (9.81 * links**2 / 2)
    work = motion.statistics
    evaluations = (work.jets.sum() + work.sweeps.sum()) / work.substeps.sum()
    return (
        f"| {links} | {dt:g} | {np.abs(error).max():.3f} | {error.mean():+.4f} | {100 * work.split_steps / steps:.1f}% "
        f"| {work.substeps.mean():.2f} | {work.jets.sum() / work.substeps.sum():.2f} | {evaluations:.2f} |"
    )


def main() -> None:
    logging.getLogger("varpin").setLevel(logging.ERROR)
    table = [
        "| links | dt [s] | largest error | mean error | split | substeps a step | jets a substep | with sweeps |",
        "|---|---|---|---|---|---|---|---|",
        *(row(links, dt) for links in (3,) for dt in (0.01, 0.05, 0.1, 0.2, 0.5)),
    ]
    print("\n".join(table))


if __name__ == "__main__":
    main()
