"""Runs a training from its configuration to a policy, in a folder from which it can continue.

Each round generates data (flown by the expert, later by the policy), fits, and selects at
intervals; the end exports. Finished work is on disk and is not repeated.
"""

import platform
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from edge.core.schema import ConfigError
from edge.core.wire import FLOAT_PAYLOADS, PAYLOAD_TYPES
from edge.policy.bundle import Bundle, load_bundle, write_bundle
from export.parameters import PolicyMessages
from lpac.sim.cores import Pool
from lpac.train.card import ModelCard, write_card
from lpac.train.config import ReadConfig, config_digest
from lpac.train.data import Shards
from lpac.train.files import write_atomically
from lpac.train.fit import Fit
from lpac.train.progress import RunProgress, Work
from lpac.train.rollout import PlannedShard, ShardTask, fly_shard, plan_round
from lpac.train.select import (
    Candidate,
    ClosedLoopCost,
    JudgedCandidate,
    Selection,
    candidates_of,
)

_CONFIG, _CHECKPOINT, _BUNDLE = "config.toml", "checkpoint.pt", "bundle"
# The payload limit is this multiple of the largest number in a payload of this many flights.
_PAYLOAD_MARGIN = 10.0
_PAYLOAD_FLIGHTS = 16
# Robots may use int8 payloads if the cost rises by no more than this factor.
_MAX_COST_RATIO = 1.01


def require_same_run(read: ReadConfig, folder: Path) -> None:
    """Check that a run in the folder can continue with `read`. Raises ConfigError, OSError."""
    begun = folder / _CONFIG
    if begun.exists() and config_digest(begun.read_text("utf-8")) != read.digest:
        raise ConfigError(
            f"{folder}: has a run of another configuration ({begun}); only dagger.rounds may "
            "change: choose another name, or --out"
        )


class TrainingRun:
    """The training in one folder."""

    def __init__(
        self, read: ReadConfig, folder: Path, report: Callable[[RunProgress], None]
    ) -> None:
        """Begin or continue. Raises ConfigError for another configuration; ValueError, OSError."""
        self._config, self._network, self._folder = read.config, read.network, folder
        self._digest = read.digest
        require_same_run(read, folder)
        write_atomically(folder / _CONFIG, read.text.encode())
        config = self._config
        self._shards = Shards(folder / "data", read.digest)
        self._fit = Fit(
            read.network, config.fit, config.dagger, config.seed, folder / "fit.pt", read.initial
        )
        self._selection = Selection(folder, read.digest, config.select, read.network.task)
        self._plans = [
            plan_round(config.data, config.dagger, config.seed, round_)
            for round_ in range(config.dagger.rounds + 1)
        ]
        self._work = self._plan_work(report)

    def run(self, pool: Pool) -> dict[str, Any]:
        """Train; returns the results, for JSON. Raises ValueError, OSError."""
        for round_ in range(self._config.dagger.rounds + 1):
            self._generate(round_, pool)
            self._train(round_, pool)
        return self._export(pool)

    def _plan_work(self, report: Callable[[RunProgress], None]) -> Work:
        """Units: robot seconds to fly, robot epochs to fit, flights to select."""
        config, robots, fit = self._config, 0, 0
        judged = len(config.select.set_ups) * config.select.worlds
        flights = 0
        for round_, shards in enumerate(self._plans):
            robots += sum(map(_robots, shards)) * config.data.states
            fit += robots * self._fit.epochs(round_)
            flights += len(self._candidates(round_)) * judged
        flown = sum(map(_robot_seconds, (shard for plan in self._plans for shard in plan)))
        work = Work({"generate": flown, "fit": fit, "select": flights}, report)
        work.skip("select", judged * len(self._selection.judged))
        return work

    def _candidates(self, round_: int) -> list[Candidate]:
        return candidates_of(round_, self._fit.epochs(round_), self._config.select.every_epochs)

    def _generate(self, round_: int, pool: Pool) -> None:
        finished, work = self._shards.facts, self._work
        missing = {shard.name: shard for shard in self._plans[round_] if shard.name not in finished}
        for shard in self._plans[round_]:
            if shard.name in finished:
                work.skip("generate", _robot_seconds(shard))
        if not missing:
            return
        bundle = self._flight_bundle(round_)
        tasks = [ShardTask(shard, bundle, self._network.task) for shard in missing.values()]
        work.begin()
        work.show("generate", round_)
        with closing(pool(fly_shard, tasks)) as outcomes:
            for name, states, cpu_s in outcomes:
                shard = missing[name]
                facts = {
                    "seed": self._config.seed,
                    "flights": len(shard.scenarios),
                    "by_expert": sum(shard.by_expert),
                    "bundle_id": bundle.id if round_ else None,
                    "cpu_s": round(cpu_s, 3),
                    "versions": _versions(),
                }
                self._shards.add(name, states, facts)
                work.add("generate", round_, _robot_seconds(shard))

    def _flight_bundle(self, round_: int) -> Bundle:
        """Bundle of a round's flights. In round 0 it only defines the inputs."""
        if round_:
            return load_bundle(self._candidate_folder(self._candidates(round_ - 1)[-1]) / _BUNDLE)
        checkpoint = self._network.checkpoint(self._fit.untrained())
        return self._network.bundle(
            checkpoint, self._config.parameters, self._config.export.name, {"training": "none"}
        )

    def _train(self, round_: int, pool: Pool) -> None:
        work, candidates = self._work, self._candidates(round_)
        data = None
        epochs = self._fit.epochs(round_)
        robots = sum(map(_robots, (s for plan in self._plans[: round_ + 1] for s in plan)))
        units = float(robots * self._config.data.states * epochs)
        done = self._fit.done(round_) / epochs
        work.skip("fit", units * done)
        for candidate in candidates:
            if self._fit.done(round_) < candidate.epoch:
                data = data or self._shards.load(round_)
                work.begin()

                def report(share: float, loss: float) -> None:
                    nonlocal done
                    work.loss = loss
                    work.add("fit", round_, units * (share - done))
                    done = share

                self._fit.run(data, round_, candidate.epoch, report)
            folder = self._candidate_folder(candidate)
            if not (folder / _BUNDLE).exists():
                self._write_candidate(candidate)
            self._judge(candidate, pool)

    def _write_candidate(self, candidate: Candidate) -> None:
        """Write a candidate. The bundle comes last, and marks it as complete."""
        checkpoint = self._network.checkpoint(self._fit.weights)
        folder = self._candidate_folder(candidate)
        write_atomically(folder / _CHECKPOINT, checkpoint)
        write_bundle(self._bundle(candidate, checkpoint, PolicyMessages()), folder / _BUNDLE)

    def _bundle(self, candidate: Candidate, checkpoint: bytes, messages: PolicyMessages) -> Bundle:
        provenance = {
            "training": f"lpac train, configuration {self._digest}, seed {self._config.seed}",
            "candidate": f"round {candidate.round}, epoch {candidate.epoch}",
        }
        parameters = replace(self._config.parameters, messages=messages)
        return self._network.bundle(checkpoint, parameters, self._config.export.name, provenance)

    def _judge(self, candidate: Candidate, pool: Pool) -> None:
        work, path, flown = self._work, self._candidate_folder(candidate) / _BUNDLE, 0
        bundle = load_bundle(path)
        work.begin()

        def report(flights: int) -> None:
            nonlocal flown
            work.add("select", candidate.round, flights - flown)
            flown = flights

        self._selection.judge(candidate, path, bundle, pool, report)
        best = self._selection.best
        work.cost = best.cost.mean if best else None

    def _candidate_folder(self, candidate: Candidate) -> Path:
        return self._folder / "candidates" / candidate.name

    def _export(self, pool: Pool) -> dict[str, Any]:
        config, name = self._config, self._config.export.name
        best = self._selection.best
        assert best is not None
        self._work.show("export", best.candidate.round)
        folder = self._candidate_folder(best.candidate)
        judged = load_bundle(folder / _BUNDLE)
        baselines = self._selection.baselines(folder / _BUNDLE, pool)
        checkpoint = (folder / _CHECKPOINT).read_bytes()
        limit = _PAYLOAD_MARGIN * self._largest_payload(judged, pool)
        int8 = self._selection.with_payload("int8", folder / _BUNDLE, judged, pool)
        over_mission = self._selection.over_mission(folder / _BUNDLE, judged, pool)
        worse = int8.mean > _MAX_COST_RATIO * best.cost.mean
        messages = PolicyMessages(
            limit if limit > 0.0 else None, FLOAT_PAYLOADS if worse else PAYLOAD_TYPES
        )
        bundle = self._bundle(best.candidate, checkpoint, messages)
        write_atomically(self._folder / f"{name}.pt", checkpoint)
        write_bundle(bundle, self._folder / name)
        card = ModelCard(
            config=config,
            expert=self._network.task.expert_name(config.data),
            digest=self._digest,
            bundle_id=bundle.id,
            best=best,
            judged=self._selection.judged,
            losses=self._fit.losses,
            baselines=baselines,
            int8=int8,
            over_mission=over_mission,
            shards=self._shards.facts,
            fit_hours=self._fit.seconds / 3600.0,
            select_hours=self._selection.seconds / 3600.0,
            device=self._fit.device,
            versions=_versions(),
        )
        write_card(card, self._folder, judged, folder / _BUNDLE)
        return {
            "folder": str(self._folder),
            "bundle": str(self._folder / name),
            "bundle_id": bundle.id,
            "checkpoint": str(self._folder / f"{name}.pt"),
            "selected": _judged_json(best),
            "candidates": [_judged_json(each) for each in self._selection.judged],
            "over_mission": {
                each or "policy": cost._asdict() for each, cost in over_mission.items()
            },
            "baselines": {each: _cost_json(cost) for each, cost in baselines.items()},
            **{
                f"below_{name.replace('-', '_')}": best.cost.mean < baselines[name].mean
                for name in ("decentralized-cvt",)
                if name in baselines
            },
            "states": sum(facts["states"] for facts in self._shards.facts.values()),
            "hours": {
                "generate_cpu": card.generate_hours,
                "fit": card.fit_hours,
                "select": card.select_hours,
            },
        }

    def _largest_payload(self, bundle: Bundle, pool: Pool) -> float:
        """Largest number in a payload of the first flights of round 0, flown by the policy."""
        scenarios = [scenario for shard in self._plans[0] for scenario in shard.scenarios]
        shards = [
            replace(
                self._plans[0][0],
                scenarios=(scenario,),
                by_expert=(False,),
                times_s=(self._config.data.duration_s,),
            )
            for scenario in scenarios[:_PAYLOAD_FLIGHTS]
        ]
        tasks = [ShardTask(shard, bundle, self._network.task) for shard in shards]
        with closing(pool(fly_shard, tasks)) as outcomes:
            return max(states.largest_payload for _, states, _ in outcomes)


def _robots(shard: PlannedShard) -> int:
    return sum(scenario.robots for scenario in shard.scenarios)


def _robot_seconds(shard: PlannedShard) -> float:
    return sum(scenario.robots * scenario.duration_s for scenario in shard.scenarios)


def _versions() -> dict[str, str]:
    return {
        "lpac-edge": version("lpac-edge"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": version("torch"),
    }


def _judged_json(judged: JudgedCandidate) -> dict[str, Any]:
    return {**judged.candidate._asdict(), **_cost_json(judged.cost)}


def _cost_json(cost: ClosedLoopCost) -> dict[str, float]:
    return {"mean": cost.mean, "p90": cost.p90, "worst": cost.worst}
