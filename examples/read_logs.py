"""The logs of a flight, as arrays and as one record of all robots; and a figure: read_logs.png.

    python examples/read_logs.py FOLDER

FOLDER has logs of robots: of `lpac fleet pull`, or of a simulated flight, such as
`lpac sim --vehicle simulated --robots 3 --duration 20 --out out/flight` makes.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from lpac.api import draw_heights, draw_states, examine, log_arrays

if len(sys.argv) != 2:
    sys.exit(__doc__)
folder = Path(sys.argv[1])

# What each robot wrote, topic by topic: columns over time, in its own clock.
try:
    logs = log_arrays(folder, "control", "received")
except (OSError, ValueError) as error:
    sys.exit(str(error))
for name, topics in sorted(logs.items()):
    control, received = topics["control"], topics["received"]
    speed_m_s = np.linalg.norm(control["velocity_m_s"], axis=1)
    in_mission = control["state"] == "mission"
    print(
        f"{name}: {in_mission.sum()} control ticks in mission, "
        f"at most {speed_m_s[in_mission].max(initial=0.0):.2f} m/s, "
        f"{len(received.time_s)} messages received"
    )

# What they did together: each mission's record, times from its begin, on one clock.
examined = examine([folder])
for note in examined.notes:
    print("note:", note)
record = examined.records[0]
if len(record.normalized):
    print(f"{record.name}: cost at the end {record.normalized[-1]:.3f} of the initial cost")
if record.separation is not None:
    print(f"{record.name}: least distance of two robots {record.separation.distance_m:.2f} m")
figure, (upper, lower) = plt.subplots(2, 1, figsize=(7.0, 4.5), sharex=True, layout="constrained")
draw_states(upper, record)
upper.set_xlabel("")
draw_heights(lower, record)
figure.savefig("read_logs.png", dpi=150)
print("see read_logs.png")
