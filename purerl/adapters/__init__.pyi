# The adapters, each once; `__init__.py` reads this list.
from purerl.adapters.brax_envs import BraxOptions as BraxOptions, from_brax as from_brax
from purerl.adapters.gymnasium_envs import (
    GymnasiumOptions as GymnasiumOptions,
    from_gymnasium as from_gymnasium,
    from_maker as from_maker,
)
from purerl.adapters.playground_envs import (
    PlaygroundOptions as PlaygroundOptions,
    from_playground as from_playground,
)
from purerl.adapters.to_dm_env import dm_env_environment as dm_env_environment
from purerl.adapters.to_gymnasium import (
    gymnasium_env as gymnasium_env,
    gymnasium_vector_env as gymnasium_vector_env,
)
