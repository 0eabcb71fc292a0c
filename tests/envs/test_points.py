"""Points in a plane: rewards, ends, walls, and that every goal can be reached."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.points.multi_goal import MultiGoal
from envs.points.point_maze import MAZES, PointMaze

FOUR = [(5, 0), (-5, 0), (0, 5), (0, -5)]
THREE = [(5, 0), (-4, 3), (-4, -3)]


def walk(env, start, towards):
    """The states of an oracle that goes straight to one place after the other, at most 1 a step."""
    step = jax.jit(env.step)
    states = [env.reset_to(start)]
    for place in map(np.asarray, towards):
        while np.linalg.norm(way := place - states[-1].obs) > 1e-3 and not states[-1].done:
            states.append(step(states[-1], jnp.asarray(way / max(1, np.linalg.norm(way)))))
    return states


@pytest.mark.parametrize("env", [MultiGoal(), PointMaze()], ids=["multi_goal", "point_maze"])
def test_the_contract(env):
    assert (env.observation_size, env.action_size, env.backend) == (2, 2, "jax")
    assert env.action_high.dtype == np.float32 and (env.action_high == 1).all()
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((2,), jnp.float32))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(
        lambda x: (x.shape, x.dtype), after
    )


# ----- multi_goal


@pytest.mark.parametrize(
    ("name", "goals", "radius", "scale"), [("four", FOUR, 1.0, 1.0), ("three", THREE, 0.5, 0.1)]
)
def test_steps_are_the_published_ones(name, goals, radius, scale):
    env = MultiGoal(name, scale)
    rng = np.random.default_rng(0)
    far, near = rng.uniform(-7, 7, (100, 2)), rng.choice(goals, 200) + rng.uniform(-1, 1, (200, 2))
    places = np.float32(np.concatenate([far, near]))
    actions = np.float32(rng.uniform(-1.3, 1.3, (300, 2)))
    after = jax.jit(jax.vmap(lambda s, a: env.step(env.reset_to(s), a)))(places, actions)
    seen = set()
    for i, (place, action) in enumerate(zip(places, actions, strict=True)):
        action = np.clip(action, -1, 1)
        place = np.clip(place + action, -7, 7)
        squares = [np.sum((place - g) ** 2.0) for g in goals]
        at_goal = min(squares) < radius**2
        reward = scale * (-30 * np.sum(action**2.0) - min(squares) + 10 * at_goal)
        np.testing.assert_allclose(after.obs[i], place, rtol=0, atol=1e-6)
        np.testing.assert_allclose(after.reward[i], reward, rtol=1e-5, atol=1e-5)
        assert (after.done[i], after.metrics["goal"][i]) == (
            at_goal, at_goal * (1 + int(np.argmin(squares))),
        )  # fmt: skip
        seen.add(int(after.metrics["goal"][i]))
    assert seen == set(range(len(goals) + 1))


def test_starts():
    """Normal with σ = 0.1, and the very centre; 6 standard errors of 4,000 draws."""
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = np.asarray(jax.vmap(MultiGoal().reset)(keys).obs)
    np.testing.assert_allclose(drawn.mean(0), 0, rtol=0, atol=6 * 0.1 / 4000**0.5)
    np.testing.assert_allclose(drawn.std(0), 0.1, rtol=6 / 8000**0.5, atol=0)
    assert (MultiGoal("three").reset(keys[0]).obs == 0).all()


@pytest.mark.parametrize("name", ["four", "three"])
def test_an_oracle_reaches_each_goal(name):
    """Steps of 1 from the centre: a way of 5 is at a goal, 1 or 0.5 wide, after 5 of them.

    (After 4 the distance is 1, which is not below it.)
    """
    env = MultiGoal(name, reward_scale=1.0)
    for number, goal in enumerate(env.goals, 1):
        states = walk(env, np.zeros(2), [goal])[1:]
        assert [s.metrics["goal"] for s in states] == [0, 0, 0, 0, number]
        total = sum(float(s.reward) for s in states)
        others = [min(np.sum((k / 5 * goal - g) ** 2) for g in env.goals) for k in range(1, 6)]
        assert total == pytest.approx(10 - 5 * 30 - sum(others), rel=1e-5)
    numbers = {m.name: m.over([0, 1, 3, 3]) for m in env.scored_metrics}
    shares = [0.25, 0, 0.5, 0][: len(env.goals)]
    entropy = -(np.log(1 / 3) / 3 + np.log(2 / 3) * 2 / 3) / np.log(len(env.goals))
    assert numbers.pop("goal_entropy") == pytest.approx(entropy, rel=1e-12)
    assert numbers == {
        "goals_reached": 2,
        **{f"goal_{i}_share": share for i, share in enumerate(shares, 1)},
    }


def test_the_four_goals_are_equally_good():
    """A quarter turn of place and action changes neither reward nor end."""
    env = MultiGoal()
    turn = np.array([[0, -1], [1, 0]], np.float32)
    rng = np.random.default_rng(1)
    places, actions = np.float32(rng.uniform([[-7], [-1]], [[7], [1]], (1000, 2, 2))).swapaxes(0, 1)
    step = jax.jit(jax.vmap(lambda s, a: env.step(env.reset_to(s), a)))
    one, other = step(places, actions), step(places @ turn.T, actions @ turn.T)
    np.testing.assert_allclose(one.reward, other.reward, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(one.done, other.done)


# ----- point_maze


def cells_of(maze):
    """By place (m) relative to the start, what is there; row by row from above."""
    rows = MAZES[maze]
    (start,) = [(i, j) for i, row in enumerate(rows) for j, c in enumerate(row) if c == "R"]
    return {
        (4.0 * (j - start[1]), 4.0 * (start[0] - i)): c
        for i, row in enumerate(rows)
        for j, c in enumerate(row)
    }


def ways(cells, goal):
    """Every way from the start to a goal that enters no cell twice: the centres on it."""
    found, waiting = [], collections.deque([[(0.0, 0.0)]])
    while waiting:
        way = waiting.popleft()
        if way[-1] == goal:
            found.append(way)
            continue
        x, y = way[-1]
        for there in ((x + 4, y), (x - 4, y), (x, y + 4), (x, y - 4)):
            if cells[there] != "1" and there not in way:
                waiting.append([*way, there])
    return found


def test_goals_are_where_they_were_published():
    np.testing.assert_array_equal(PointMaze("v1").goals, [[-8, 0]])
    np.testing.assert_array_equal(PointMaze("v2").goals, [[0, 12], [-12, 0], [12, 0], [0, -12]])


@pytest.mark.parametrize(("maze", "number_of_ways"), [("v1", 2), ("v2", 1)])
def test_an_oracle_reaches_each_goal_of_a_maze(maze, number_of_ways):
    env, cells = PointMaze(maze), cells_of(maze)
    goals = [place for place, cell in cells.items() if cell == "G"]
    np.testing.assert_array_equal(env.goals, goals)
    for number, goal in enumerate(goals, 1):
        found = ways(cells, goal)
        assert len(found) == number_of_ways
        for way in found:
            states = walk(env, np.zeros(2), way)
            rewards = [float(s.reward) for s in states]
            assert rewards == [0.0] * (len(states) - 1) + [10.0]
            assert [bool(s.done) for s in states] == [r > 0 for r in rewards]
            assert states[-1].metrics["goal"] == number
            assert np.linalg.norm(states[-1].obs - np.asarray(goal)) < 0.5


@pytest.mark.parametrize("maze", sorted(MAZES))
def test_walls_are_never_entered(maze):
    """64 points under random actions that are held for a while."""
    env, cells = PointMaze(maze), cells_of(maze)
    rng = np.random.default_rng(0)
    actions = np.repeat(np.float32(rng.uniform(-1, 1, (64, 60, 2))), 10, axis=1)

    def play(key, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state.obs

        return jax.lax.scan(step, env.reset(key), actions)[1]

    places = np.asarray(jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(0), 64), actions))
    centres = map(tuple, 4 * np.floor(places.reshape(-1, 2) / 4 + 0.5))
    seen = {cells[centre] for centre in centres}
    assert "1" not in seen and {"0", "R"} <= seen


def test_an_axis_that_would_end_in_a_wall_stands_still():
    env = PointMaze("v1")  # the start's cell has walls to its right (x = 2) and left (x = -2)
    after = env.step(env.reset_to(np.array([1.5, 0.0])), jnp.asarray([0.75, 0.5]))
    np.testing.assert_allclose(after.obs, [1.5, 0.5], rtol=0, atol=1e-6)
    after = env.step(env.reset_to(np.array([-1.5, 0.0])), jnp.asarray([-0.25, 0.5]))
    np.testing.assert_allclose(after.obs, [-1.75, 0.5], rtol=0, atol=1e-6)


# ----- drawings


@pytest.mark.parametrize("env", [MultiGoal("three"), PointMaze("v2")], ids=["goals", "maze"])
def test_paths_are_drawn(env, player, tmp_path):
    """Both paths are in the page, to the millimetre, and it needs no other file."""
    episodes = []
    for goal in env.goals[:2]:
        states = walk(env, np.zeros(2), [goal])
        places = np.stack([s.obs for s in states])
        episodes.append(envs.Episode(places, places, np.zeros((len(places) - 1, 2))))
    heads = np.array([[1, 0], [0, 1], [-0.5, -0.5]])

    def value(observations, actions):
        return -np.linalg.norm(observations[:, None] + actions, axis=-1)

    picture, page = env.render(episodes, player(heads, value), tmp_path)
    assert (picture.name, page.name) == ("paths.png", "paths.html")
    assert picture.read_bytes().startswith(b"\x89PNG")
    text = page.read_text(encoding="utf-8")
    assert "data:image/png;base64," in text and "http" not in text and "$page" not in text
    for episode in episodes:
        x, y = episode.observations[-1].astype(float).round(3)
        assert f"[{x},{y}]" in text
    assert "[-0.5,-0.5]" in text  # a proposal
