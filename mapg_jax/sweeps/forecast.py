"""How long a sweep will take, from a short measurement on this machine."""

import time

import jax

from mapg_jax.sweeps.groups import Group
from mapg_jax.training.config import ReplayConfig
from mapg_jax.training.lockstep import Lockstep, program_key

MEASURED_SECONDS = 1.0
START_SECONDS = 15.0
"""A process until its first turn: Python, imports, compilation."""


def predict(cut: list[Group], workers: int) -> float:
    """Seconds that the groups take.

    Of each program one group, the one with the most heads, is compiled and run for a second or
    more, learning, and plays one evaluation of its fresh policy. An evaluation is counted as if all
    its episodes lasted to the time limit.
    """
    costs: dict[tuple, float] = {}
    for group in sorted(cut, key=lambda group: -max(job.config.heads for job in group)):
        if _kind(group) not in costs:
            costs[_kind(group)] = _seconds(group)
    return sum(costs[_kind(group)] for group in cut) / workers


def _kind(group: Group) -> tuple:
    return program_key(group[0].config), len(group)


def _seconds(group: Group) -> float:
    config = group[0].config
    program = Lockstep([job.config for job in group])
    trainer = program.trainer
    state = program.init()
    run = program.jitted_run.lower(state, 0).compile()
    begins = config.learning_starts if isinstance(config, ReplayConfig) else 0
    turns = begins // trainer.steps_per_turn + 1
    state, _ = _timed(run, state, turns)
    seconds, counted = 0.0, 0
    while seconds < MEASURED_SECONDS:
        turns = max(turns, 2 * counted)
        state, more = _timed(run, state, turns)
        seconds, counted = seconds + more, counted + turns
    evaluate, keys = program.jitted_evaluation, program.evaluation_keys(0)
    evaluate(state.agent, keys)  # compiles
    played, evaluation = _timed(evaluate, state.agent, keys)
    evaluation *= trainer.env.time_limit / int(played.lengths.max())
    turns = -(-config.steps // trainer.steps_per_turn)
    evaluations = turns / max(1, round(config.evaluate_every / trainer.steps_per_turn))
    final = config.final_episodes / config.evaluation_episodes
    return START_SECONDS + turns * seconds / counted + (evaluations + final) * evaluation


def _timed(function, *arguments):
    begun = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - begun
