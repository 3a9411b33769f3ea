"""dm_control's control suite, the 28 tasks of its benchmark, with one set of settings.

python -m purerl.run suite --env.task cheetah-run --name cheetah-run

Expected: return 915 of 1000 after 10 min, on one CPU core; others: docs/measurements/suite.md.
Humanoids learn nothing with these: `suite_humanoid` has settings for them. A GPU: `suite_gpu`.
"""

from envs.suite import tasks
from purerl import Config, Evaluation, Experiment, networks

experiment = Experiment(
    build_env=tasks.build,
    env=tasks.Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(
        policy_hidden=(128, 128),
        value_hidden=(128, 128),
        initial_std=1.0,
        min_std=0.2,  # with 0.001, a cart-pole's was 0.04, steps became leaps, and the pole fell
    ),
    ppo=Config(
        num_steps=10_000_000,
        num_envs=64,
        rollout_length=128,  # no push of the noise lasts longer, and a swing of a pole has 160
        shortest_episode=32,  # where the goal is reached soon, starts are what is to be learned
        num_epochs=4,
        num_minibatches=16,
        noise_color=0.75,  # with white noise, three of five hanging poles never swung up
        min_advantage_std=0.01,  # without it, a policy that has earned nothing yet follows noise
        learning_rate=1e-3,
        schedule="linear",
        advantage_clip=4.0,  # without it, one fall of a pole that always stood undid a policy
        entropy_weight=0.01,
        entropy_target=0.3,  # beyond it, a bonus only holds a hopper down
        reward_scaling="return_std",
        reward_scale=1.0,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
