"""Reach a point with Gymnasium's Reacher while the strength of its motors is unknown.

Neither reward nor end is written: the model learns them.
In this folder: `headway train reacher:spec --preset quick --run-dir reacher`, then
`headway record reacher -o reacher.gif`.
"""

import headway

spec = headway.EnvSpec(
    env_id="Reacher-v5",
    sim_params=headway.SimParamSets(
        train={"gear": (0.5, 1.0, 2.0)}, unseen={"strong": {"gear": (3.0,)}}
    ),
)
