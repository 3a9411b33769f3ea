"""One file an experiment: what you copy to start your own.

From small to large: cartpole_swingup, ant_run, ant_gaps, ant_gaps_eyes, ant_two_touch, rodent_run,
rodent_gaps, rodent_gaps_eyes, rodent_bowl, rodent_maze, rodent_maze_eyes, rodent_two_touch,
rodent_joystick, ant_intention, humanoid_imitation, rodent_imitation, rodent_intention,
ant_gaps_reuse, rodent_gaps_reuse; then suite, suite_gpu and suite_humanoid (28 tasks of
dm_control), humanoid_run, and custom_network (your own network). The help page lists them in this
order.
"""
