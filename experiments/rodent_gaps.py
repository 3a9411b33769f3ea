r"""dm_control's rodent runs along a corridor whose gaps differ in every episode.

python -m purerl.run rodent_gaps

Expected after 12 M steps (71 min on two CPU cores with other work beside it), in 128 unseen
corridors: 3.0 gaps crossed on average, one or more in all, five or more in 23%, at most 12; the
policy of `rodent_run`, which does not see them, 1.1; standing still, none. It leaps, and falls into
the wide ones. It goes on learning for ten times as long: with MJX-Warp, 160 M steps in 21 min of an
H200, one seed gallops at 1.8 m/s over every gap (23.9 in 10 s, 21 at least), another crosses 11.1:

python -m purerl.run rodent_gaps --engine warp --ppo.num-envs 4096 --ppo.rollout-length 16 \
    --ppo.num-minibatches 64 --ppo.num-steps 160000000

With fewer environments it learns in fewer steps. Five seeds, the three of this command and two more
at once, cross 5, 19, 5, 18 and 8 gaps after 26 M, all in 23 min of one H100. The fastest
cross the most:

python -m purerl.run rodent_gaps --engine warp --num-seeds 3 --seed 20 --ppo.num-envs 1024 \
    --ppo.rollout-length 16 --ppo.num-minibatches 16 --ppo.num-steps 26000000

`docs/measurements/gpu.md` has their curves, and other rewards and settings over 21 M steps.
"""

from envs import run
from purerl import Config, Evaluation, Experiment, networks

experiment = Experiment(
    build_env=run.build,
    env=run.Options(
        body="rodent",
        arena="gaps",
        platform_length=(0.4, 0.8),
        gap_length=(0.05, 0.2),
        corridor_width=2.0,
        reward="target",
        target_speed=1.5,
        # Where an end at the body's own 3 cm stops it, it can climb out of a gap again.
        least_height=-0.1,
    ),
    build_network=networks.mlp,
    # A scale that depends on what it feels lets it run with noise and step across without.
    network=networks.MlpOptions(
        policy_hidden=(256, 256), value_hidden=(256, 256), std="state", initial_std=0.3
    ),
    ppo=Config(
        num_steps=12_000_000,
        num_envs=256,
        rollout_length=32,
        num_epochs=4,
        num_minibatches=8,
        episode_length=500,  # 10 s
        learning_rate=3e-4,
        schedule="linear",
        gamma=0.99,
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
