"""The point robot: a ball with two motors.

    ct-jax train point --preset demo                          # minutes on two CPU cores
    ct-jax train point --preset cpu                           # 36 to 47 minutes on one CPU core
    ct-jax train point --preset published                     # 5 minutes on an H200 with 16 CPU cores
    ct-jax train point --preset paper                         # wants a GPU

Success to expect in antmaze-large (seen) and antmaze-large-eval (unseen): ``cpu`` 99.7 and 97.3 %, ``published`` 76.7
and 66.7 % (three models each; ``docs/results/point.md``). The learner of the controller takes a minute.
"""

from ct_jax.configs.base import PRESETS as SHARED

PRESETS = dict(SHARED)
