"""Read the decisions of a run as a pandas DataFrame. Needs the extra `data`."""

import pandas

from airl_mav import Scenario, rehearse

run = rehearse(Scenario(latency="lognormal:150ms,30ms", level="gym", episodes=3), out="runs/late")

episodes = pandas.DataFrame(run.table("episodes")).set_index("index")
decisions = pandas.DataFrame(run.table("decisions"))
latency = decisions.groupby("episode").t2_ms.agg(["count", "mean", "max"]).round(1)
print(episodes[["seed", "outcome"]].join(latency))
print("the same as files: airl export-data runs/late --format csv")
