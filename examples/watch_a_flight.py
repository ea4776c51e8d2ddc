"""A flight that is looked at while it lasts, and ended when the cost is 0.6 of the first."""

from lpac.api import SHIPPED_BUNDLE, FlightMoment, Scenario, fly, load_bundle

costs: list[float] = []


def watch(moment: FlightMoment) -> None:
    """Called each 0.2 s of the flight; here something is done once a second."""
    if round(moment.time_s % 1.0, 6) not in (0.0, 1.0):
        return
    costs.append(moment.cost)
    received = moment.received.sum(axis=1)  # neighbours that each robot receives
    speed_m_s = (moment.velocities_m_s**2).sum(axis=1) ** 0.5
    print(
        f"{moment.time_s:4.1f} s  cost {moment.cost / costs[0]:.3f} of the first, "
        f"speed {speed_m_s.mean():.2f} m/s, {received.min()} to {received.max()} neighbours"
    )
    if moment.cost < 0.6 * costs[0]:
        moment.stop()


scenario = Scenario(robots=6, seed=6, duration_s=60.0, loss=0.3)
flight = fly(scenario, load_bundle(SHIPPED_BUNDLE), watch)
lost, accepted = flight.message_counts["lost"], flight.message_counts["accepted"]
print(f"ended after {flight.duration_s:g} s; {lost} messages lost, {accepted} accepted")
