"""A world of your own, a robot that fails on the way, and the figure: own_world.png."""

import matplotlib.pyplot as plt

from lpac.api import (
    SHIPPED_BUNDLE,
    Failure,
    GaussianFeature,
    PolygonFeature,
    Scenario,
    draw_costs,
    draw_snapshot,
    fly,
    load_bundle,
)

# Model units, 16 to the metre, from the world's corner; a Gaussian's scale is its integral.
features = (
    GaussianFeature(mean=(128.0, 128.0), sigma=(50.0, 30.0), correlation=0.4, scale=8.0),
    GaussianFeature(mean=(380.0, 400.0), sigma=(60.0, 60.0), scale=10.0),
    PolygonFeature(vertices=((300.0, 60.0), (460.0, 60.0), (460.0, 140.0)), importance=4e-4),
)
starts_m = tuple((2.0 + 2.0 * robot, 2.0) for robot in range(4))
bundle = load_bundle(SHIPPED_BUNDLE)
flights = {
    name: fly(
        Scenario(
            robots=4, duration_s=12.0, features=features, starts_m=starts_m, failures=failures
        ),
        bundle,
    )
    for name, failures in (("all fly", ()), ("robot 3 fails", (Failure(3, from_s=5.0),)))
}
figure, panels = plt.subplots(1, 3, figsize=(11.0, 3.2), layout="constrained")
for axes, (name, flight) in zip(panels[:2], flights.items(), strict=True):
    draw_snapshot(axes, flight, time_s=12.0)
    axes.set_title(name)
draw_costs(panels[2], flights)
figure.savefig("own_world.png")
for name, flight in flights.items():
    print(f"{name}: {flight.normalized[-1]:.3f} of the initial cost")
print("see own_world.png")
