# The interface: every public name, once. `__init__.py` reads this list, and so do type checkers and
# editors. A line is a name's place: the reference in docs/ has what its docstring says.
# ruff: isort: skip_file

# Train, and use what was trained.
from purerl.training.train import train as train  # a run: the folder and bits of `purerl.run`
from purerl.runs.loaded_run import load as load  # a run read back from its folder
from purerl.runs.loaded_run import Run as Run  # what these two return
from purerl.runs.policy import Policy as Policy  # a run's `policy(observation) -> action`
from purerl.report.video import frames as frames  # a run's policy, drawn

# An experiment.
from purerl.experiment.definition import Experiment as Experiment  # what is trained, and how
from purerl.experiment.definition import Part as Part  # of a network: frozen, or of another run
from purerl.experiment.loading import find as find  # an experiment by name, file or module
from purerl.ppo.config import Config as Config  # the settings of PPO
from purerl.ppo.config import Evaluation as Evaluation  # of the evaluations during training

# An environment.
from purerl.core.env import Env as Env  # the protocol
from purerl.core.env import State as State  # one environment between two steps
from purerl.core.env import EnvError as EnvError  # a rule of the protocol that is broken
from purerl.checks.check_env import check_env as check_env  # finds such
from purerl.physics.interface import Physics as Physics  # MuJoCo on the engines c, jax and warp
from purerl.physics.interface import PhysicsState as PhysicsState
from purerl.physics.interface import choose_engine as choose_engine  # which engine "auto" is
from purerl.physics.interface import overflow_metric as overflow_metric  # contacts left out
from purerl.physics.interface import overflow_reading as overflow_reading
from purerl.physics import lookup as lookup  # a module: MuJoCo's names to indices

# A network: a pair of pure functions, and what they return.
from purerl.core.records import Network as Network
from purerl.core.records import PolicyOutput as PolicyOutput
from purerl.core.records import Normal as Normal
from purerl.ppo import networks as networks  # a module: mlp, recurrent, from_linen

# The algorithm, for a loop of your own.
from purerl.ppo.algorithm import init as init  # the first state
from purerl.ppo.algorithm import update as update  # the next one
from purerl.ppo.evaluation import evaluate_policy as evaluate_policy  # whole episodes
from purerl.core.records import TrainState as TrainState  # all that a run is

# For annotations.
from purerl.core.records import Array as Array
from purerl.core.records import PyTree as PyTree

# Errors.
from purerl.core.errors import UserError as UserError  # a wrong call
from purerl.core.errors import RunError as RunError  # a run that cannot go on
from purerl.core.errors import StoppedError as StoppedError  # a run that was asked to stop

# Rooms and modules that are useful alone.
from purerl import adapters as adapters  # environments of Gymnasium, dm_env, brax, Playground
from purerl import clips as clips  # recorded motion
from purerl import eyes as eyes  # what a body sees, and networks that see
from purerl import exact as exact  # programs of MJX with their sums in a fixed order
from purerl.tune.plan import planner as planner  # behaviour by search, without learning

__version__: str

# For the library itself.
HOMES: dict[str, str]

def listed(file: str) -> dict[str, str]: ...
def what_to_write(name: str, package: str = ...) -> str: ...
def how_to_install(extra: str) -> str: ...
