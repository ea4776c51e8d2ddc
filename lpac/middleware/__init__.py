"""The paper's experiments on the network: throughput while programs restart, and over robots.

What speaks and what is measured are programs of their own, as on robots: at each place one that
is a robot (`robot`) and, at two of them, the ends of a bulk stream (`stream`). `places` starts
them, on this machine's loopback or in network namespaces, and `measure` makes the runs. A
middleware is an adapter of two calls (`kinds`, `over_zenoh`, `over_cyclone`). What runs came
to is pure (`results`).
"""
