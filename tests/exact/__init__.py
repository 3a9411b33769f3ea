"""What the tests of `purerl.exact` share."""

import jax

from purerl import exact
from purerl.exact.traces import sub_jaxprs

GPU = "gpu"  # whose programs a CPU runs, too


def rewritten(function, *example, platform="cpu", fuse=True):
    """Returns the trace of a rewritten function."""
    return jax.make_jaxpr(exact.rewrite(function, platform=platform, fuse=fuse))(*example)


def named(closed, name):
    """Returns the equations of a primitive at any depth."""
    inside = (sub for e in closed.jaxpr.eqns for sub in sub_jaxprs(e))
    found = [eqn for eqn in closed.jaxpr.eqns if eqn.primitive.name == name]
    return found + [eqn for sub in inside for eqn in named(sub, name)]


def for_gpu(physics):
    """Makes the `jax` engine of a Physics compute as on a GPU."""
    from purerl.physics.engine_mjx import JaxEngine

    old = physics._engine
    engine = JaxEngine(physics.model, old.record, old.late, old.substeps, platform=GPU)
    engine._exact_step = exact.rewrite(engine.plain_step, platform=GPU)  # small ones, too
    physics._engine = engine
    return physics
