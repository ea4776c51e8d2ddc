"""The paper's network experiments: throughput while programs restart, and over robots.

Senders and meters are separate processes, as on robots: one robot (`robot`) at each place and, at
two of them, the ends of a bulk stream (`stream`). `places` starts them on this machine's loopback
or in network namespaces; `measure` makes the runs. Each middleware has a small adapter (`kinds`,
`over_zenoh`, `over_cyclone`, `over_fastdds`). `results` evaluates the runs.
"""
