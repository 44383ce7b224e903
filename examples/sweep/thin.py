"""Makes a small table from the metrics.csv of a run, such as the tables in docs/curves: python thin.py RUN TABLE

A row covers the iterations of 400 000 control steps. It holds their means, the steps at its end, and the sums of the times in seconds.
An iteration with an evaluation is the last of its row, so that evaluations appear at the steps at which they were made.
"""

import csv
import sys
from pathlib import Path

MEANS = ["episode/goals", "episode/in_tolerance", "episode/drop_rate", "episode/rot_dist", "episode/length", "training/progress"]
MEANS += ["training/turned", "policy/std", "eval/goals", "eval/drop_rate", "eval/rot_dist"]
# Only a training with randomised episodes has these. Runs from before `training/turned` was logged lack that column.
RANDOMIZED = ["randomized/goals", "randomized/drop_rate", "randomized/rot_dist"]
# The return measures only a training on the task's own reward.
RETURNS = ["episode/return", "eval/return"]
SUMS = ["time/collect_s", "time/update_s"]
STEPS = 400_000


def numbers(rows, column):
    return [float(row[column]) for row in rows if row.get(column) not in (None, "", "NaN")]


def main(run, table):
    rows = list(csv.DictReader(open(Path(run) / "metrics.csv")))
    # A fork does not begin at 0 steps.
    length = int(rows[1]["env_steps"]) - int(rows[0]["env_steps"]) if len(rows) > 1 else 0
    groups, begun = [[]], int(rows[0]["env_steps"]) - length
    for row in rows:
        groups[-1].append(row)
        if int(row["env_steps"]) - begun >= STEPS or row["eval/goals"]:
            groups.append([])
            begun = int(row["env_steps"])
    Path(table).parent.mkdir(parents=True, exist_ok=True)
    with open(table, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        columns = [column for column in MEANS + RANDOMIZED if column in rows[0]]
        columns += RETURNS if float(rows[0].get("training/task_reward") or 0) == 1 else []
        writer.writerow(["env_steps", *columns, *SUMS])
        # The last group has too few iterations for a mean.
        for group in groups[:-1]:
            found = [numbers(group, column) for column in columns]
            means = [f"{sum(values) / len(values):.5g}" if values else "" for values in found]
            writer.writerow([group[-1]["env_steps"], *means, *(f"{sum(numbers(group, column)):.2f}" for column in SUMS)])


main(*sys.argv[1:])
