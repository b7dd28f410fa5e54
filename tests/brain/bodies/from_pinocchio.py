"""Makes fixtures/vectors/chain.json: what Pinocchio computes of random chains and of a real arm.

    pip install pin==4.1.0        # 380 MB: not among the extras
    python -m tests.brain.bodies.from_pinocchio

Each case has its URDF, and for some states the tip's frame in the base's (rotation by rows, origin), the
geometric Jacobian of the tip by rows (linear, angular), the torques of gravity alone and those of the motion.
The arm is the UR5, by the numbers of ur_description (Universal Robots, BSD-3-Clause), as in
github.com/Gepetto/example-robot-data, robots/ur_description/urdf/ur5_robot.urdf.
"""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

FILE = Path(__file__).parents[3] / "fixtures" / "vectors" / "chain.json"
STATES, CHAINS, SEED = 4, 8, 20260913

UR5 = (  # joint, origin, pitch, axis, velocity, effort, mass, centre (z), xx = yy, zz
    ("pan", (0.0, 0.0, 0.089159), 0.0, "0 0 1", 3.15, 150, 3.7, 0.0, 0.010267495893, 0.00666),
    ("lift", (0.0, 0.13585, 0.0), 1.57079632679, "0 1 0", 3.15, 150, 8.393, 0.28, 0.22689067591, 0.0151074),
    ("elbow", (0.0, -0.1197, 0.425), 0.0, "0 1 0", 3.15, 150, 2.275, 0.25, 0.049443313556, 0.004095),
    ("wrist_1", (0.0, 0.0, 0.39225), 1.57079632679, "0 1 0", 3.2, 28, 1.219, 0.0, 0.111172755531, 0.21942),
    ("wrist_2", (0.0, 0.093, 0.0), 0.0, "0 0 1", 3.2, 28, 1.219, 0.0, 0.111172755531, 0.21942),
    ("wrist_3", (0.0, 0.0, 0.09465), 0.0, "0 1 0", 3.2, 28, 0.1879, 0.0, 0.0171364731454, 0.033822),
)


def ur5() -> str:
    """Return the URDF of the arm: its joints, limits and masses."""
    parts = ['<robot name="ur5"><link name="base"/>']
    parent = "base"
    for name, xyz, pitch, axis, velocity, effort, mass, centre, xx, zz in UR5:
        inertia = f'<inertia ixx="{xx}" ixy="0" ixz="0" iyy="{xx}" iyz="0" izz="{zz}"/>'
        body = f'<origin xyz="0 0 {centre}"/><mass value="{mass}"/>{inertia}'
        turn = 3.14159265359 if name == "elbow" else 6.28318530718
        parts += [
            f'<link name="{name}_link"><inertial>{body}</inertial></link>',
            (
                f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
                f'<origin xyz="{" ".join(map(str, xyz))}" rpy="0 {pitch} 0"/><axis xyz="{axis}"/>'
                f'<limit lower="{-turn}" upper="{turn}" velocity="{velocity}" effort="{effort}"/></joint>'
            ),
        ]
        parent = f"{name}_link"
    parts.append(
        '<link name="tip"/><joint name="tool" type="fixed"><parent link="wrist_3_link"/><child link="tip"/>'
        '<origin xyz="0 0.0823 0" rpy="-1.57079632679 0 0"/></joint></robot>'
    )
    return "\n".join(parts)


def some(rng: random.Random, count: int, most: float) -> list[float]:
    """Return some numbers of 6 digits within ± most."""
    return [round(rng.uniform(-most, most), 6) for _ in range(count)]


def words(numbers: list[float]) -> str:
    """Return numbers as an attribute."""
    return " ".join(map(str, numbers))


def random_urdf(rng: random.Random) -> str:
    """Return a tree of 3 to 9 joints of all kinds, with links fixed to them and one that hangs aside."""
    parts, parent = ['<robot name="random"><link name="base"/>'], "base"
    count = rng.randint(2, 8)
    for i in range(2 * count + 2):
        aside = i == 2 * count
        name = "tip" if i == 2 * count + 1 else f"link{i}"
        fixed = name == "tip" or i % 2 == 1
        kind = "fixed" if fixed else rng.choice(["revolute", "continuous", "revolute", "prismatic"])
        a, b, c = (rng.uniform(0.01, 0.05) for _ in range(3))  # second moments: any body has b + c, …
        xx, yy, zz = round(b + c, 6), round(a + c, 6), round(a + b, 6)
        inertia = f'ixx="{xx}" ixy="0.001" ixz="-0.002" iyy="{yy}" iyz="0.0015" izz="{zz}"'
        place = f'<origin xyz="{words(some(rng, 3, 0.2))}" rpy="{words(some(rng, 3, 3.0))}"/>'
        mass = f'{place}<mass value="{round(rng.uniform(0.1, 3.0), 6)}"/><inertia {inertia}/>'
        limit = '<limit lower="-2.5" upper="2.5" velocity="3" effort="50"/>' if not fixed else ""
        parts.append(f'<link name="{name}"><inertial>{mass}</inertial></link>')
        parts.append(
            f'<joint name="to_{name}" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
            f'<origin xyz="{words(some(rng, 3, 0.5))}" rpy="{words(some(rng, 3, 3.0))}"/>'
            f'<axis xyz="{words(some(rng, 3, 1.0))}"/>{limit}</joint>'
        )
        parent = parent if aside else name
    return "\n".join((*parts, "</robot>"))


def states_of(urdf: str, rng: random.Random) -> dict[str, Any]:
    """Return what Pinocchio computes."""
    import numpy as np
    import pinocchio as pin  # type: ignore[import-not-found, unused-ignore]

    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    tip = model.getFrameId("tip")
    names = list(model.names)[1:]
    found = []
    for _ in range(STATES):
        q, v, a = some(rng, model.nv, 2.0), some(rng, model.nv, 3.0), some(rng, model.nv, 5.0)
        full = np.zeros(model.nq)  # a continuous joint is (cos, sin) to it
        for i, joint in enumerate(list(model.joints)[1:]):
            angle = (np.cos(q[i]), np.sin(q[i])) if joint.nq == 2 else (q[i],)
            full[joint.idx_q : joint.idx_q + joint.nq] = angle
        pin.computeJointJacobians(model, data, full)
        pin.updateFramePlacements(model, data)
        at = data.oMf[tip]
        jacobian = pin.getFrameJacobian(model, data, tip, pin.LOCAL_WORLD_ALIGNED)
        gravity = pin.computeGeneralizedGravity(model, data, full)
        torques = pin.rnea(model, data, full, np.array(v), np.array(a))
        results = {"rotation": at.rotation, "origin": at.translation, "jacobian": jacobian}
        results |= {"gravity": gravity, "torques": torques}
        arrays = {key: np.asarray(value).tolist() for key, value in results.items()}
        found.append({"q": q, "v": v, "a": a} | arrays)
    return {"urdf": urdf, "joints": names, "states": found}


def cases() -> dict[str, Any]:
    """Return the content of the file."""
    import pinocchio as pin  # type: ignore[import-not-found, unused-ignore]

    rng = random.Random(SEED)
    urdfs = [ur5(), *(random_urdf(rng) for _ in range(CHAINS))]
    return {
        "source": f"Pinocchio {pin.__version__} (stack-of-tasks, BSD-2-Clause), gravity 9.81",
        "made_by": "tests/brain/bodies/from_pinocchio.py",
        "cases": [states_of(urdf, rng) for urdf in urdfs],
    }


if __name__ == "__main__":
    FILE.write_text(json.dumps(cases()) + "\n", encoding="utf-8")
