# The names of `__init__.py`, for editors and type checkers; a test compares the two.
from purerl import exact as exact
from purerl.core.env import Env as Env
from purerl.core.env import EnvError as EnvError
from purerl.core.env import State as State
from purerl.core.errors import RunError as RunError
from purerl.core.errors import StoppedError as StoppedError
from purerl.core.errors import UserError as UserError
from purerl.core.records import Array as Array
from purerl.core.records import Network as Network
from purerl.core.records import Normal as Normal
from purerl.core.records import PolicyOutput as PolicyOutput
from purerl.core.records import PyTree as PyTree
from purerl.physics import lookup as lookup
from purerl.physics.interface import Physics as Physics
from purerl.physics.interface import PhysicsState as PhysicsState
from purerl.physics.interface import choose_engine as choose_engine
from purerl.physics.interface import overflow_metric as overflow_metric
from purerl.physics.interface import overflow_reading as overflow_reading
from purerl.ppo import networks as networks
from purerl.ppo.config import Config as Config
from purerl.ppo.config import Evaluation as Evaluation
from purerl.runs.check_env import check_env as check_env
from purerl.runs.experiment import Experiment as Experiment
from purerl.runs.experiment import find as find
from purerl.runs.loaded_run import Run as Run
from purerl.runs.loaded_run import load as load
from purerl.runs.policy import Policy as Policy
from purerl.runs.training import train as train

__version__: str
