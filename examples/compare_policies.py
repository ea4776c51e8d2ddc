"""Two policies and a baseline over the same worlds: which is better, and how certain that is.

Two worlds tell nothing, and it says so: with 50 it takes minutes, as `lpac evaluate` does.
"""

from pathlib import Path

from lpac.api import (
    SET_UPS,
    SHIPPED_BUNDLE,
    VERDICT_RULE,
    Condition,
    Method,
    Study,
    cost_curves,
    load_bundle,
    run,
    verdict_of,
    what_would_tell,
)

OTHER_BUNDLE = Path(__file__).parents[1] / "policies" / "general" / "general"

# Three robots in a world of three features, as the field is but smaller; and lossy messages.
small = SET_UPS["n3"]
study = Study(
    methods=(
        Method.of("field", SHIPPED_BUNDLE),
        Method.of("general", OTHER_BUNDLE),
        Method.of("decentralized-cvt"),
    ),
    conditions=(
        Condition(scenario=small.scenario(duration_s=6.0)),
        Condition(scenario=small.scenario(duration_s=6.0, loss=0.5)),
    ),
    worlds=2,
)
print("field:", load_bundle(SHIPPED_BUNDLE).id[:12], "general:", load_bundle(OTHER_BUNDLE).id[:12])
# With all cores: run(study, over_cores), below `if __name__ == "__main__":`.
results = run(study)
for condition, of_all in results.items():
    print(f"\n{condition.name}: cost after 6 s over the initial cost, a number per world")
    for result in of_all:  # `final` is (trainings, worlds)
        print(
            f"  {result.method.name:18} {result.final[0].round(3)}  mean {result.final.mean():.3f}"
        )
condition, (field, general, *_) = next(iter(results.items()))
verdict = verdict_of(field, general)
value, low, high = verdict.ratio
print(f"\nfield over general: {value:.3f} (95 %: {low:.3f} to {high:.3f})")
better = {"a": "field is better", "b": "general is better"}
undecided = what_would_tell(verdict.difference, study.worlds)
print(better.get(verdict.better, undecided))
print(f"the rule: {VERDICT_RULE}")
cost_curves(condition, results[condition]).savefig("compare_policies.png")
print("see compare_policies.png")
