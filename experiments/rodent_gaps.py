r"""dm_control's rodent runs along a corridor whose gaps differ in every episode.

python -m purerl.run rodent_gaps

Two CPU cores take 3 h 20 min. With MJX-Warp one H100 trains ten seeds at once, in some 40 min:

python -m purerl.run rodent_gaps --engine warp --num-seeds 10 --seed 30

Expected: a bounding gallop over every gap. After 28 M steps these ten seeds cross 8 to 22 gaps in
10 s, eight of them 17 or more; the lower quartile is 17.6. After 12 M they cross 3 to 4: the rest
comes while the learning rate falls. Five seeds whose rate fell within 25 M cross 6 to 18. A policy
of `rodent_run`, which does not see the gaps, crosses 1.1; standing still, none.

`lab/2026-11-26-rodents-with-warp.md` has their curves, and other rewards and settings.
"""

from purerl import Config, Evaluation, Experiment, networks
from purerl.envs import run

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
        policy_hidden=(256, 256),
        value_hidden=(256, 256),
        std="state",
        initial_std=0.3,
        min_std=1e-3,
    ),
    ppo=Config.plain(
        num_steps=32_000_000,
        num_envs=512,
        rollout_length=16,
        num_epochs=4,
        num_minibatches=8,
        episode_length=500,  # 10 s
        noise_color=0.75,  # the actuators lag by 40 ms, and damp a push of one step (20 ms)
        learning_rate=2e-4,
        schedule="linear",
        gamma=0.99,
        reward_scale=0.1,
    ),
    evaluation=Evaluation(num_episodes=32, number=10),
)
