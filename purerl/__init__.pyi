# The names of `__init__.py`, for editors and type checkers; a test compares the two.
from purerl import adapters as adapters, exact as exact
from purerl.checks.check_env import check_env as check_env
from purerl.core.env import Env as Env, EnvError as EnvError, State as State
from purerl.core.errors import (
    RunError as RunError,
    StoppedError as StoppedError,
    UserError as UserError,
)
from purerl.core.records import (
    Array as Array,
    Network as Network,
    Normal as Normal,
    PolicyOutput as PolicyOutput,
    PyTree as PyTree,
)
from purerl.experiment.definition import Experiment as Experiment
from purerl.experiment.loading import find as find
from purerl.physics import lookup as lookup
from purerl.physics.interface import (
    Physics as Physics,
    PhysicsState as PhysicsState,
    choose_engine as choose_engine,
    overflow_metric as overflow_metric,
    overflow_reading as overflow_reading,
)
from purerl.ppo import networks as networks
from purerl.ppo.config import Config as Config, Evaluation as Evaluation
from purerl.runs.loaded_run import Run as Run, load as load
from purerl.runs.policy import Policy as Policy
from purerl.training.train import train as train
from purerl.tune.plan import planner as planner

__version__: str
