# ruff: noqa: E501 (tables of attributes)
"""Draws models of MuJoCo at random, over the elements and attributes of MJCF.

`draw(rng)` returns an MJCF. Most of them compile; who draws asks MuJoCo which.
"""

from typing import Any

import numpy as np

Rng = np.random.Generator
FLAGS = [
    "actuation",
    "autoreset",
    "clampctrl",
    "constraint",
    "contact",
    "damper",
    "equality",
    "eulerdamp",
    "filterparent",
    "frictionloss",
    "gravity",
    "island",
    "limit",
    "midphase",
    "multiccd",
    "nativeccd",
    "refsafe",
    "sensor",
    "spring",
    "warmstart",
]
ENABLED = ["energy", "fwdinv", "invdiscrete", "override", "sleep", "diagexact"]
MOVING = ["framepos", "framequat", "framexaxis", "frameyaxis", "framezaxis"]
MOVING += ["framelinvel", "frameangvel"]


def text(value: Any) -> str:
    """Returns a value as an attribute has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return value if isinstance(value, str) else " ".join(f"{x:.5g}" for x in np.atleast_1d(value))


def tag(kind: str, inside: str = "", /, **attributes: Any) -> str:
    """Returns an element; attributes that are None are left out."""
    words = [f'{k.rstrip("_")}="{text(v)}"' for k, v in attributes.items() if v is not None]
    return f"<{' '.join([kind, *words])}>{inside}</{kind}>\n"


class Draw:
    """What has been drawn so far, by kind, so that others can refer to it."""

    def __init__(self, rng: Rng, size: int, rare: float):
        """`size` bounds the number of bodies; `rare` scales the chance of what is unusual."""
        self.rng, self.size, self.rare = rng, size, rare
        self.bodies: list[str] = []  # that move
        self.joints: dict[str, str] = {}  # name -> type
        self.limited: list[str] = []
        self.geoms: dict[str, str] = {}
        self.sites: list[str] = []
        self.cameras: list[str] = []
        self.tendons: list[str] = []
        self.actuators: list[str] = []

    def yes(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def odd(self, p: float, value: Any) -> Any:
        """Returns a value, or None: left out as a rule."""
        return value if self.yes(p * self.rare) else None

    def one(self, of: Any) -> Any:
        of = list(of)
        return of[self.rng.integers(len(of))]

    def u(self, low: float, high: float, n: int | None = None) -> Any:
        return self.rng.uniform(low, high, n)

    def quat(self) -> np.ndarray | None:
        q = self.rng.normal(size=4)
        return q / np.linalg.norm(q) if self.yes(0.5) else None

    def place(self, far: float = 0.2) -> dict[str, Any]:
        return {"pos": self.u(-far, far, 3) if self.yes(0.7) else None, "quat": self.quat()}

    def solver(self, *names: str) -> dict[str, Any]:
        """Attributes of constraints: solref and solimp under their names."""
        soft = [self.u(0.005, 0.05), self.u(0.5, 1.5)], [-self.u(100, 2000), -self.u(5, 50)]
        limp = [self.u(0.5, 0.9), self.u(0.9, 0.99), self.u(0.0005, 0.01), 0.5, self.one((1, 2, 3))]
        return {n: self.odd(0.2, self.one(soft) if "ref" in n else limp) for n in names}

    def poly(self, p: float, high: float) -> Any:
        """A coefficient, or a polynomial's three."""
        return self.odd(p, self.u(0, high) if self.yes(0.8) else self.u(0, high / 3, 3))


def joint(d: Draw, kind: str) -> str:
    name = f"j{len(d.joints)}"
    d.joints[name] = kind
    low = d.u(-1.2, 0.1)
    limit = d.yes(0.4) and kind != "free"
    if limit:
        d.limited.append(name)
    ends = [0, d.u(0.3, 1.5)] if kind == "ball" else [low, low + d.u(0.2, 1.5)]
    scalar = kind in ("hinge", "slide")
    if kind == "free" and d.yes(0.6):
        return tag("freejoint", name=name)
    return tag(
        "joint", name=name, type=kind, limited=limit,
        class_=d.odd(0.2, "soft"),
        range=ends if limit else None,
        pos=d.odd(0.3, d.u(-0.1, 0.1, 3)) if kind != "free" else None,
        axis=d.rng.normal(size=3) if scalar and d.yes(0.6) else d.one(np.eye(3)) if scalar else None,
        damping=d.poly(0.5, 2.0), stiffness=d.poly(0.3, 20.0), armature=d.odd(0.3, d.u(0, 0.3)),
        frictionloss=d.odd(0.25, d.u(0, 1)), springref=d.odd(0.2, d.u(-1, 1)) if scalar else None,
        ref=d.odd(0.1, d.u(-0.5, 0.5)) if scalar else None, margin=d.odd(0.2, d.u(0, 0.2)),
        springdamper=d.odd(0.05, d.u(0.1, 1, 2)) if scalar else None,
        actuatorfrcrange=d.odd(0.15, [-d.u(0.5, 5), d.u(0.5, 5)]) if scalar else None,
        actuatorgravcomp=d.odd(0.1, True), **d.solver(*["solreflimit", "solimplimit", "solreffriction", "solimpfriction"]),
    )  # fmt: skip


def geom(d: Draw, static: bool, kinds: tuple[str, ...]) -> str:
    name, kind = f"g{len(d.geoms)}", d.one(kinds)
    d.geoms[name] = kind
    sizes = {"plane": [2, 2, 0.1], "mesh": None, "hfield": None, "sphere": d.u(0.03, 0.15)}
    ends = kind in ("capsule", "cylinder") and d.yes(0.4)
    if ends:
        sizes[kind] = d.u(0.03, 0.1)
    elif kind in ("capsule", "cylinder"):
        sizes[kind] = d.u(0.03, 0.15, 2)
    place = {} if ends else d.place(0.1) if not static else {"pos": [0, 0, d.u(-0.4, -0.1)]}
    return tag(
        "geom", name=name, type=kind, size=sizes.get(kind, d.u(0.03, 0.15, 3)),
        fromto=np.concatenate([d.u(-0.05, 0.05, 3), d.u(0.1, 0.3, 3)]) if ends else None,
        mesh="m0" if kind == "mesh" else None, hfield="h0" if kind == "hfield" else None,
        class_=d.odd(0.2, "soft"), mass=d.odd(0.2, d.u(0.1, 2)), density=d.odd(0.2, d.u(200, 2000)),
        condim=d.odd(0.5, d.one((1, 3, 4, 6))), priority=d.odd(0.15, d.one((1, 2))),
        friction=d.odd(0.4, [d.u(0.1, 1.5), d.u(0.001, 0.1), d.u(0.0001, 0.01)]),
        margin=d.odd(0.2, d.u(0, 0.05)), gap=d.odd(0.1, d.u(0, 0.02)), solmix=d.odd(0.1, d.u(0.1, 2)),
        contype=d.odd(0.15, d.one((0, 1, 2))), conaffinity=d.odd(0.15, d.one((0, 1, 3))),
        group=d.odd(0.2, d.one(range(6))), shellinertia=d.odd(0.05, kind in ("box", "sphere")),
        fluidshape=d.odd(0.1, "ellipsoid") if kind not in ("plane", "hfield") else None,
        adhesion=d.odd(0.05, d.u(0, 5)), surfacevel=d.odd(0.05, d.u(-1, 1, 6)),
        **place, **d.solver("solref", "solimp"),
    )  # fmt: skip


def body(d: Draw, depth: int, kinds: tuple[str, ...]) -> str:
    """A body with joints and what hangs on it."""
    name = f"b{len(d.bodies)}"
    d.bodies.append(name)
    inside = ""
    if depth == 0 and d.yes(0.4):
        inside += joint(d, "free")
    else:
        some = d.rng.permutation(["slide", "hinge", "hinge", "ball"])[: d.one((0, 1, 1, 1, 2, 3))]
        for kind in sorted(some, key=lambda kind: kind != "slide"):  # no rotation after a ball
            inside += joint(d, kind) if kind != "ball" or len(some) == 1 else ""
    if d.yes(0.15):
        inertia = (
            {"diaginertia": d.u(0.01, 0.02, 3)}
            if d.yes(0.5)
            else {"fullinertia": [*d.u(0.02, 0.03, 3), *d.u(-0.005, 0.005, 3)]}
        )
        quat = {"quat": d.quat()} if "diaginertia" in inertia else {}
        inside += tag("inertial", pos=d.u(-0.05, 0.05, 3), mass=d.u(0.2, 2), **inertia, **quat)
    for _ in range(d.one((1, 1, 2))):
        inside += geom(d, False, kinds)
    for _ in range(d.one((0, 1, 1, 2))):
        d.sites.append(f"s{len(d.sites)}")
        inside += tag("site", name=d.sites[-1], type=d.one(("sphere", "box", "capsule", "cylinder", "ellipsoid")),
                      size=d.u(0.05, 0.2, 3), **d.place())  # fmt: skip
    if d.yes(0.15 * d.rare):
        d.cameras.append(f"c{len(d.cameras)}")
        mode = d.one(("fixed", "track", "trackcom", "targetbody", "targetbodycom"))
        inside += tag("camera", name=d.cameras[-1], mode=mode, target=d.bodies[0] if "target" in mode else None,
                      resolution=[8, 6], **d.place())  # fmt: skip
        inside += tag("light", mode=d.one(("fixed", "track", "trackcom")), pos=d.u(-1, 1, 3))
    while len(d.bodies) < d.size and d.yes(0.55):
        inside += body(d, depth + 1, kinds)
    simple = "false" if d.yes(0.1) else None
    return tag("body", inside, name=name, gravcomp=d.odd(0.15, d.u(0, 1.2)), simple=simple,
               pos=d.u(-0.25, 0.25, 3) + (depth == 0) * np.array([0, 0, 0.3]), quat=d.quat())  # fmt: skip


def tendon(d: Draw) -> str:
    scalars = [n for n, kind in d.joints.items() if kind in ("hinge", "slide")]
    name, inside = f"t{len(d.tendons)}", ""
    fixed = scalars and (len(d.sites) < 2 or d.yes(0.5))
    if not fixed and len(d.sites) < 2:
        return ""
    if fixed:
        for n in d.rng.permutation(scalars)[: d.one((1, 2, 3))]:
            inside += tag("joint", joint=n, coef=d.u(-2, 2))
    else:
        path = list(d.rng.permutation(d.sites)[: d.one((2, 2, 3, 4))])
        round_ = [g for g, kind in d.geoms.items() if kind in ("sphere", "cylinder")]
        for i, site in enumerate(path):
            inside += tag("site", site=site)
            if round_ and i + 1 < len(path) and d.yes(0.4):
                inside += tag("geom", geom=d.one(round_), sidesite=d.odd(0.5, d.one(d.sites)))
            elif 0 < i < len(path) - 2 and d.yes(0.3):
                inside += tag("pulley", divisor=2) + tag("site", site=site)
    d.tendons.append(name)
    limit = d.yes(0.3)
    d.limited += [name] * limit
    low = d.u(-0.3, 0.1) if fixed else d.u(0, 0.2)
    return tag(
        "fixed" if fixed else "spatial", inside, name=name, limited=limit,
        range=[low, low + d.u(0.1, 0.6)] if limit else None, stiffness=d.poly(0.4, 30), damping=d.poly(0.4, 2),
        frictionloss=d.odd(0.25, d.u(0, 1)), margin=d.odd(0.2, d.u(0, 0.1)),
        armature=d.odd(0.15, d.u(0, 0.2)) if "geom" not in inside else None, springlength=d.odd(0.3, d.one(([d.u(0, 0.5)], [0.1, d.u(0.1, 0.5)]))),
        actuatorfrcrange=d.odd(0.1, [-d.u(0.5, 5), d.u(0.5, 5)]),
        **d.solver(*["solreflimit", "solimplimit", "solreffriction", "solimpfriction"]),
    )  # fmt: skip


def actuator(d: Draw) -> str:
    kinds = [
        "motor",
        "position",
        "velocity",
        "general",
        "intvelocity",
        "damper",
        "cylinder",
        "muscle",
    ]
    if d.yes(0.2 * d.rare):
        kinds = ["adhesion", "orientation", "pid", "dcmotor"]
    kind, name = d.one(kinds), f"a{len(d.actuators)}"
    scalars = [n for n, k in d.joints.items() if k in ("hinge", "slide")]
    where: list[dict[str, Any]] = [{"joint": n} for n in (scalars if d.yes(0.8) else d.joints)]
    if d.yes(0.35):
        where = [{"tendon": n} for n in d.tendons] or where
    if d.yes(0.2) and d.sites:
        where = [{"site": d.one(d.sites), "refsite": d.odd(0.5, d.one(d.sites))}]
    if d.yes(0.05 * d.rare) and len(d.sites) > 1:
        where = [{"cranksite": d.sites[0], "slidersite": d.sites[1], "cranklength": 0.4}]
    if d.yes(0.1 * d.rare) and d.joints:
        where = [{"jointinparent": d.one(d.joints)}]
    if kind == "adhesion":
        where = [{"body": n} for n in d.bodies]
    if kind == "orientation":
        where = [{"joint": n} for n, k in d.joints.items() if k == "ball"]
    if not where:
        return ""
    at, high = d.one(where), d.u(0.3, 2)
    own: dict[str, Any] = {
        "position": {"kp": d.u(1, 30), "kv": d.odd(0.5, d.u(0, 3)), "timeconst": d.odd(0.2, d.u(0.01, 0.2))},
        "velocity": {"kv": d.u(0.1, 3)},
        "intvelocity": {"kp": d.u(1, 30), "actrange": [-d.u(0.2, 1), d.u(0.2, 1)]},
        "damper": {"kv": d.u(0.1, 3), "ctrlrange": [0, high]},
        "cylinder": {"area": d.u(0.5, 2), "bias": d.u(-1, 1, 3), "timeconst": d.u(0.05, 1)},
        "muscle": {"lengthrange": [-0.5, 1], "force": d.odd(0.6, d.u(1, 50)), "tausmooth": d.odd(0.3, 0.05)},
        "adhesion": {"gain": d.u(0.1, 5), "ctrlrange": [0, high]},
        "orientation": {"kp": d.u(1, 10), "kv": d.u(0, 1)},
        "pid": {"kp": d.u(1, 30), "ki": d.odd(0.5, d.u(0.1, 3)), "kv": d.u(0, 2), "imax": d.odd(0.3, 1), "slewmax": d.odd(0.3, 3)},
        "dcmotor": {"motorconst": [d.u(0.1, 1), d.u(0.1, 1)], "resistance": d.u(0.5, 3), "inductance": d.odd(0.5, [d.u(0.01, 0.1), 0.01])},
    }.get(kind, {})  # fmt: skip
    if kind == "general":
        dyn = d.one(("none", "none", "integrator", "filter", "filterexact", "muscle"))
        gain = d.one(("fixed", "fixed", "affine", "muscle"))
        own = {"dyntype": dyn, "dynprm": d.u(0.02, 0.3, 3) if dyn != "none" else None, "gaintype": gain,
               "gainprm": d.u(0.2, 3, 3) if gain != "muscle" else [0.75, 1.05, 20, 200, 0.5, 1.6, 1.5, 1.3, 1.2],
               "biastype": d.one(("none", "affine")), "biasprm": d.u(-2, 0, 3),
               "lengthrange": [-0.5, 1], "actearly": d.odd(0.15, True) if dyn != "none" else None,
               "actrange": d.odd(0.4, [-0.5, 0.5]) if dyn == "integrator" else None}  # fmt: skip
    if kind not in ("adhesion", "damper") and d.yes(0.5):
        own["ctrlrange"] = [0 if kind == "muscle" else -high, high]
    if kind != "orientation" and kind != "adhesion":
        wide = "site" in at or d.joints.get(at.get("joint", ""), "") in ("free", "ball")
        own["gear"] = d.u(-2, 2, 6) if wide else d.odd(0.4, d.u(-3, 3))
        if "joint" in at or "tendon" in at:
            own |= {"damping": d.odd(0.08, d.u(0, 1)), "armature": d.odd(0.05, d.u(0, 0.2))}
    d.actuators.append(name)
    if kind != "dcmotor":
        own["forcerange"] = d.odd(
            0.2, [0 if kind == "orientation" else -d.u(0.5, 10), d.u(0.5, 10)]
        )
    if d.yes(0.02 * d.rare):
        own |= {"delay": 0.01, "nsample": 8}
    return tag(kind, name=name, group=d.odd(0.3, d.one((1, 2))), **at, **own)


def equality(d: Draw) -> str:
    kind = d.one(("connect", "weld", "joint", "tendon"))
    scalars = [n for n, k in d.joints.items() if k in ("hinge", "slide")]
    rest = {"active": d.odd(0.15, False), **d.solver("solref", "solimp")}
    if kind in ("connect", "weld"):
        more = {"torquescale": d.odd(0.3, d.u(0.1, 2))} if kind == "weld" else {}
        if len(d.sites) > 1 and d.yes(0.4):
            a, b = d.rng.permutation(d.sites)[:2]
            return tag(kind, site1=a, site2=b, **more, **rest)
        second = d.one(d.bodies[1:]) if len(d.bodies) > 1 and d.yes(0.6) else None
        anchor = d.u(-0.1, 0.1, 3) if kind == "connect" or d.yes(0.5) else None
        if kind == "weld" and d.yes(0.4):
            more["relpose"] = [*d.u(-0.1, 0.1, 3), *d.rng.normal(size=4)]
        return tag(kind, body1=d.bodies[0], body2=second, anchor=anchor, **more, **rest)
    names = scalars if kind == "joint" else d.tendons
    if not names:
        return ""
    both = d.rng.permutation(names)
    poly = d.odd(0.6, [d.u(-0.2, 0.2), 1, d.u(-0.3, 0.3), 0, 0])
    return tag(
        kind,
        polycoef=poly,
        **{f"{kind}1": both[0], f"{kind}2": both[1] if len(both) > 1 else None},
        **rest,
    )


def sensor(d: Draw) -> str:
    """One of any type whose object there is."""
    bodies, geoms, scalars = (
        d.bodies,
        list(d.geoms),
        [n for n, k in d.joints.items() if k in ("hinge", "slide")],
    )
    balls = [n for n, k in d.joints.items() if k == "ball"]
    things = (
        [("body", n) for n in bodies]
        + [("xbody", n) for n in bodies]
        + [("geom", n) for n in geoms]
    )
    things += [("site", n) for n in d.sites] + [("camera", n) for n in d.cameras]
    kinds: dict[str, list[dict[str, Any]]] = {}
    for kind in [
        "touch",
        "accelerometer",
        "velocimeter",
        "gyro",
        "force",
        "torque",
        "magnetometer",
        "rangefinder",
    ]:
        kinds[kind] = [{"site": n} for n in d.sites]
    kinds["rangefinder"] += [{"camera": n} for n in d.cameras]
    for kind in ("jointpos", "jointvel", "jointactuatorfrc"):
        kinds[kind] = [{"joint": n} for n in scalars]
    for kind in ("tendonpos", "tendonvel", "tendonactuatorfrc"):
        kinds[kind] = [{"tendon": n} for n in d.tendons]
    for kind in ("actuatorpos", "actuatorvel", "actuatorfrc"):
        kinds[kind] = [{"actuator": n} for n in d.actuators]
    for kind in ("ballquat", "ballangvel"):
        kinds[kind] = [{"joint": n} for n in balls]
    for end in ("limitpos", "limitvel", "limitfrc"):
        kinds[f"joint{end}"] = [{"joint": n} for n in d.limited if n in d.joints]
        kinds[f"tendon{end}"] = [{"tendon": n} for n in d.limited if n in d.tendons]
    for kind in (*MOVING, "framelinacc", "frameangacc"):
        kinds[kind] = [{"objtype": t, "objname": n} for t, n in things]
    for kind in ("subtreecom", "subtreelinvel", "subtreeangmom"):
        kinds[kind] = [{"body": n} for n in bodies]
    for kind in ("distance", "normal", "fromto"):
        kinds[kind] = [{"geom1": n, "geom2": geoms[-1], "cutoff": d.u(0.1, 1)} for n in geoms[:-1]]
        kinds[kind] += [{"body1": n, "body2": bodies[-1], "cutoff": 1} for n in bodies[:-1]]
    kinds["contact"] = [{"geom1": n} for n in geoms] + [
        {"subtree1": bodies[0]},
        {"body1": bodies[-1]},
        {},
    ]
    kinds["insidesite"] = [
        {"site": d.one(d.sites), "objtype": t, "objname": n} for t, n in things if d.sites
    ]
    kinds["camprojection"] = [{"camera": n, "site": d.one(d.sites)} for n in d.cameras if d.sites]
    kinds["user"] = [{"dim": 2, "needstage": d.one(("pos", "vel", "acc")), "datatype": "real"}]
    for kind in ("e_potential", "e_kinetic", "clock"):
        kinds[kind] = [{}]
    kind = d.one([k for k, of in kinds.items() if of])
    own = dict(d.one(kinds[kind]))
    if kind == "contact":
        own |= {
            "data": "found force dist pos",
            "num": d.one((1, 3)),
            "reduce": d.one(("none", "mindist", "maxforce", "netforce")),
        }
    if kind == "rangefinder" and d.yes(0.3 * d.rare):
        own["data"] = d.one(("dist dir", "dist normal", "point"))
    if kind in MOVING and d.yes(0.3):
        own |= dict(zip(("reftype", "refname"), d.one(things), strict=True))
    uncut = (*MOVING[1:5], "contact", "user", "fromto", "normal", "camprojection", "ballquat")
    if "cutoff" not in own and kind not in uncut:
        own["cutoff"] = d.odd(0.15, d.u(0.1, 2))
    return tag(kind, noise=d.odd(0.1, 0.1), **own)


def option(d: Draw) -> str:
    """Options, and which bits are set."""
    flags = {n: "disable" for n in FLAGS if d.yes(0.02 * d.rare)}
    flags |= {n: "enable" for n in ENABLED if d.yes(0.02 * d.rare)}
    windy = d.yes(0.25 * d.rare)
    return tag(
        "option", tag("flag", **flags), integrator=d.one(("Euler", "implicit", "implicitfast", "RK4", "discrete")),
        cone=d.one(("pyramidal", "elliptic")), jacobian=d.one(("auto", "dense", "sparse")),
        solver=d.one(("Newton", "Newton", "CG", "PGS")), timestep=d.one((0.001, 0.002, 0.005)),
        iterations=d.odd(0.2, d.one((1, 4, 50))), ls_iterations=d.odd(0.1, d.one((4, 10))), tolerance=d.odd(0.1, 1e-4),
        gravity=d.odd(0.2, d.u(-5, 5, 3)), impratio=d.odd(0.1, d.u(1, 10)), magnetic=d.odd(0.1, d.u(-1, 1, 3)),
        density=d.u(1, 1000) if windy else None, viscosity=d.u(0, 0.1) if windy else None, wind=d.u(-2, 2, 3) if windy else None,
        noslip_iterations=d.odd(0.05, 3), o_margin=d.odd(0.1, 0.01), o_solref=d.odd(0.1, [0.03, 1]),
        actuatorgroupdisable=d.odd(0.05, 1), ccd_iterations=d.odd(0.05, 20),
    )  # fmt: skip


def draw(rng: Rng, size: int = 5, rare: float = 1.0) -> str:
    """Returns an MJCF of at most `size` moving bodies or a few more."""
    d = Draw(rng, size, rare)
    kinds = (
        ("sphere", "capsule")
        if rare == 0 or d.yes(0.3)
        else ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
    )
    floor = geom(
        d,
        True,
        ("plane", "plane", "box") if rare == 0 else ("plane", "plane", "hfield", "box", "mesh"),
    )
    soft = tag(
        "default",
        tag("joint", damping=d.u(0, 1), armature=0.02)
        + tag("geom", friction=d.u(0.2, 1), condim=3),
        class_="soft",
    )
    assets = tag("mesh", name="m0", vertex=d.u(-0.15, 0.15, 3 * d.one((5, 8, 12))))
    assets += tag(
        "hfield", name="h0", nrow=4, ncol=5, size=[1, 1, 0.2, 0.1], elevation=d.u(0, 1, 20)
    ) + tag("material", name="p")
    world = floor if d.yes(0.8) else ""
    if not world:
        d.geoms.clear()
    if d.yes(0.25):
        d.sites.append("sm")
        world += tag(
            "body",
            tag("geom", size=0.05) + tag("site", name="sm"),
            name="mocap",
            mocap=True,
            **d.place(0.5),
        )
    while len(d.bodies) < max(1, d.size - 2):
        world += body(d, 0, kinds)
    tendons = "".join(tendon(d) for _ in range(d.one((0, 0, 1, 2))))
    actuators = "".join(actuator(d) for _ in range(d.one((0, 1, 2, 3))))
    equalities = "".join(equality(d) for _ in range(d.one((0, 0, 1, 2))))
    sensors = "".join(sensor(d) for _ in range(d.one((0, 2, 5, 9))))
    contact = ""
    if len(d.bodies) > 1 and d.yes(0.3 * d.rare):
        contact += tag("exclude", body1=d.bodies[0], body2=d.bodies[1])
    names = [n for n, kind in d.geoms.items() if kind != "hfield"]
    if len(names) > 1 and d.yes(0.3 * d.rare):
        a, b = d.rng.permutation(names)[:2]
        contact += tag("pair", geom1=a, geom2=b, condim=d.one((1, 3, 4)), margin=d.odd(0.3, 0.05), gap=d.odd(0.2, 0.01),
                       friction=d.odd(0.5, d.u(0.1, 1, 5)), **d.solver("solref", "solimp", "solreffriction"))  # fmt: skip
    parts = {
        "asset": assets,
        "worldbody": world,
        "contact": contact,
        "tendon": tendons,
        "actuator": actuators,
    }
    parts |= {"equality": equalities, "sensor": sensors, "keyframe": tag("key", time=1.0)}
    compiler = tag("compiler", angle="radian", autolimits=d.odd(0.1, True), inertiafromgeom=d.odd(0.05, True),
                   balanceinertia=True, boundmass=0.01, boundinertia=0.0005)  # fmt: skip
    return tag(
        "mujoco",
        compiler + option(d) + tag("default", soft) + "".join(tag(k, v) for k, v in parts.items()),
    )
