"""Two policies and a baseline over the same worlds: which is better, and how certain that is.

Two worlds tell nothing, and it says so: with 50 it takes minutes, as `lpac evaluate` does.
"""

from pathlib import Path

from lpac.api import (
    SHIPPED_BUNDLE,
    VERDICT_RULE,
    Condition,
    cost_curves,
    evaluate,
    load_bundle,
    make_evaluation,
    policy_method,
    verdict_of,
    what_would_tell,
)

OTHER_BUNDLE = Path(__file__).parents[1] / "policies" / "general" / "general"

# Three robots in a world of three features, as the field is but smaller; and lossy messages.
conditions = [Condition("n3"), Condition("n3", loss=0.5)]
evaluation = make_evaluation(
    [policy_method("field", SHIPPED_BUNDLE), policy_method("general", OTHER_BUNDLE)],
    baselines=["decentralized-cvt"],
    conditions=conditions,
    worlds=2,
    duration_s=6.0,
)
print("field:", load_bundle(SHIPPED_BUNDLE).id[:12], "general:", load_bundle(OTHER_BUNDLE).id[:12])
# With all cores: evaluate(evaluation, over_cores), below `if __name__ == "__main__":`.
results = evaluate(evaluation)
for condition, of_all in results.items():
    print(f"\n{condition.name}: cost after 6 s over the initial cost, a number per world")
    for result in of_all:  # `final` is (trainings, worlds)
        print(
            f"  {result.method.name:18} {result.final[0].round(3)}  mean {result.final.mean():.3f}"
        )
field, general, *_ = results[conditions[0]]
verdict = verdict_of(field, general)
value, low, high = verdict.ratio
print(f"\nfield over general: {value:.3f} (95 %: {low:.3f} to {high:.3f})")
better = {"a": "field is better", "b": "general is better"}
undecided = what_would_tell(verdict.difference, evaluation.worlds)
print(better.get(verdict.better, undecided))
print(f"the rule: {VERDICT_RULE}")
cost_curves(conditions[0], results[conditions[0]]).savefig("compare_policies.png")
print("see compare_policies.png")
