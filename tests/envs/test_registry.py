"""Names, engines and options; what is wrong is named, and what would be right."""

import dataclasses
import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.fast import Fast

import envs
from envs.base import Env, State
from envs.interop.brax import BraxEnv
from envs.mujoco_env import ENGINES
from envs.mujoco_tasks.hopper import Hopper
from envs.mujoco_tasks.task import ASSETS


class Line(Env):
    """A point on a line, moved by its action; the reward is minus its distance from a goal."""

    action_size, observation_size, backend = 1, 1, "jax"
    action_high = np.ones(1, np.float32)

    def __init__(self, goal: float = 0.5):
        self.goal = goal

    def reset(self, rng):
        zero = jnp.zeros(())
        return State(None, jnp.zeros(1), zero, zero, {}, {})

    def step(self, state, action):
        position = state.obs + self.clipped(action)
        return state.replace(obs=position, reward=-abs(position[0] - self.goal))


@pytest.fixture
def registrations(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(envs.registry, "_SPECS", dict(envs.registry._SPECS))


@pytest.fixture
def installed(tmp_path, monkeypatch, registrations):
    """install(name, source): a package that names an environment `name`, and its only module."""

    def install(name, source):
        module = name.replace("-", "_") + "_module"
        (tmp_path / f"{module}.py").write_text(source)
        about = tmp_path / f"the_{name}_package-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Name: the-{name}-package\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[mapg_jax.envs]\n{name} = {module}\n")
        return module

    monkeypatch.syspath_prepend(tmp_path)
    yield install
    for module in [m for m, found in sys.modules.items() if _is_below(found, tmp_path)]:
        del sys.modules[module]


def _is_below(module, folder):
    return str(getattr(module, "__file__", None)).startswith(str(folder))


def test_names_are_gymnasiums_tasks():
    assert envs.names() == (
        "pendulum",
        "hopper",
        "walker2d",
        "halfcheetah",
        "swimmer",
        "humanoid",
        "inverted_pendulum",
        "inverted_double_pendulum",
        "ant",
        "reacher",
        "pusher",
        "humanoid_standup",
        "driving",
        "two_mode_bandit",
        "four_bump_bandit",
        "multi_goal",
        "point_maze",
    )


@pytest.mark.parametrize("name", [n for n in envs.names() if envs.spec(n).gymnasium_id])
def test_specs_agree_with_gymnasium(name):
    spec, env = envs.spec(name), envs.make(name)
    reference = gymnasium.make(spec.gymnasium_id)
    assert isinstance(env, Env)
    assert spec.time_limit == reference.spec.max_episode_steps
    assert env.observation_size == reference.observation_space.shape[0]
    assert env.action_size == reference.action_space.shape[0]
    assert env.dt == reference.unwrapped.dt
    assert env.action_high.dtype == np.float32
    np.testing.assert_array_equal(env.action_high, reference.action_space.high)
    np.testing.assert_array_equal(-env.action_high, reference.action_space.low)


@pytest.mark.usefixtures("their_code")
@pytest.mark.parametrize(("device", "engine"), [("cpu", "native"), ("gpu", "mjx"), ("tpu", "mjx")])
def test_auto_takes_the_engine_of_the_device(device, engine, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    assert envs.make("hopper").backend == engine
    assert envs.make("pendulum").backend == "jax"


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("hoper", {}, r"unknown environment 'hoper'; known are pendulum, hopper, .*brax:<name>"),
        ("hopper", {"engine": "jax"}, r"hopper has no engine 'jax'; it has native, mjx"),
        ("pendulum", {"engine": "native"}, r"pendulum has no engine 'native'; it has jax"),
        ("pendulum", {"gravity": 1}, r"pendulum has no option 'gravity'; it has g$"),
        ("swimmer", {"healthy_reward": 1}, r"no option 'healthy_reward'; it has xml_file, frame_"),
        ("swimmer", {"frame_skip": 0}, r"frame_skip must be at least 1, got 0"),
        ("swimmer", {"restricted": True}, r"Q3C's table has no K for Swimmer: write restricted=K"),
        ("hopper", {"restricted": 0}, r"restricted must be True or K above 0 and finite, got 0"),
        ("hopper", {"restricted": -1.0}, r"restricted must be True or K above 0 .*, got -1.0"),
        ("hopper", {"restricted": np.inf}, r"restricted must be True or K above 0 .*, got inf"),
        ("hopper", {"restricted": 1e-30}, r"restricted=1e-30 leaves no valid action: its balls "),
        ("hopper", {"restricted": "yes"}, r"option restricted must be bool . float, got 'yes'"),
        ("point_maze", {"maze": "v9"}, r"unknown maze 'v9'; known are v1, v2$"),
        ("multi_goal", {"goals": "five"}, r"goals must be 'four' or 'three', got 'five'"),
        ("multi_goal", {"reward_scale": 0}, r"reward_scale must be above 0 and finite, got 0"),
        ("swimmer", {"xml_file": "squid.xml"}, r"there is no model file /.*squid.xml$"),
        ("swimmer", {"xml_file": "./squid.xml"}, r"/.*squid.xml; relative paths begin at the work"),
        ("brax:hoper", {}, r"Brax has no environment 'hoper'; it has ant, .*walker2d"),
        (
            "brax:ant",
            {"backend": "x"},
            r"backend must be 'generalized' or 'spring' or .*, got 'x'$",
        ),
        ("brax:ant", {"engine": "mjx"}, r"brax:ant has no engine 'mjx'; it has jax"),
        ("brax:ant", {"speed": 1}, r"brax:ant has no option 'speed'; it has ctrl_cost_weight, "),
    ],
)
def test_bad_input_is_named(name, arguments, message):
    with warnings.catch_warnings(), pytest.raises(ValueError, match=message):
        warnings.simplefilter("error")  # one line, and nothing of Brax's before it
        envs.make(name, **arguments)


def test_a_model_file_of_ones_own_is_loaded(monkeypatch):
    def friction(**options):
        return envs.make("walker2d", "native", **options).task.model.geom("foot_geom").friction[0]

    monkeypatch.chdir(ASSETS)  # whose walker2d.xml is that of Walker2d-v4
    assert friction() == 1.9
    assert friction(xml_file="./walker2d.xml") == 0.9
    assert friction(xml_file=str(ASSETS / "walker2d.xml")) == 0.9


def test_names_cost_no_heavy_import():
    code = """
import sys
import envs
assert envs.spec(envs.names()[1]).time_limit == 1000
print(*{"jax", "numpy", "mujoco", "brax", "gymnasium", "matplotlib"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


def test_an_environment_costs_no_import_of_what_it_does_without():
    code = """
import sys
import envs
envs.make("hopper", "native"), envs.make("pendulum")
print(*{"mujoco.mjx", "brax", "gymnasium", "matplotlib"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


# ----- one's own


@pytest.mark.usefixtures("registrations")
def test_a_registered_environment_is_made_by_its_name():
    envs.register("my-line_2", Line, time_limit=7, gymnasium_id="Line-v0")
    assert envs.names()[-1] == "my-line_2"
    spec = envs.spec("my-line_2")
    assert (spec.time_limit, spec.gymnasium_id, spec.engines) == (7, "Line-v0", ("jax",))
    env = envs.make("my-line_2", goal=2)
    assert isinstance(env, Line) and env.goal == 2
    with pytest.raises(ValueError, match="my-line_2 has no option 'aim'; it has goal"):
        envs.make("my-line_2", aim=1)
    with pytest.raises(ValueError, match="my-line_2's option goal must be float, got 'far'"):
        envs.make("my-line_2", goal="far")
    with pytest.raises(ValueError, match="my-line_2 has no engine 'mjx'; it has jax"):
        envs.make("my-line_2", engine="mjx")


@pytest.mark.usefixtures("registrations", "their_code")
@pytest.mark.parametrize(
    "engine",
    [pytest.param(x, marks=pytest.mark.warp) if x == "mjx-warp" else x for x in ENGINES],
)
def test_a_registered_task_runs_on_every_engine(engine):
    @dataclasses.dataclass(frozen=True, eq=False)
    class LowHopper(Hopper):
        healthy_z_range: tuple[float, float] = (0.3, 2.0)

    envs.register("low_hopper", LowHopper, time_limit=100)
    assert envs.spec("low_hopper").engines == tuple(ENGINES)
    env = envs.make("low_hopper", engine, healthy_z_range=(0.5, 1.5))
    assert env.backend == engine and env.task.healthy_z_range == (0.5, 1.5)


@pytest.mark.usefixtures("registrations", "their_code")
def test_functions_text_and_braxs_environments_are_registered_too():
    def near(goal: float, *, slack: float = 0.0) -> Line:
        return Line(goal + slack)

    envs.register("near", near, time_limit=7)
    assert envs.make("near", goal=1.0, slack=0.5).goal == 1.5
    with pytest.raises(ValueError, match="near needs the option 'goal'"):
        envs.make("near")
    envs.register("text", "envs.pendulum:Pendulum", time_limit=7)
    assert envs.make("text", g=5.0).g == 5
    envs.register("theirs", Fast, time_limit=7)
    assert isinstance(envs.make("theirs"), BraxEnv)


@pytest.mark.usefixtures("registrations")
@pytest.mark.parametrize(
    ("name", "time_limit", "message"),
    [
        ("hopper", 1, "there is an environment 'hopper' already"),
        ("brax:mine", 1, "name is letters, digits, - and _, .*; got 'brax:mine'"),
        ("my env", 1, "got 'my env'"),
        ("-mine", 1, "got '-mine'"),
        ("../mine", 1, "got '../mine'"),
        ("mine\n", 1, r"got 'mine\\n'"),
        ("", 1, "got ''"),
        ("mine", 0, "time_limit must be at least 1 step, got 0"),
    ],
)
def test_registrations_that_cannot_be_are_refused(name, time_limit, message):
    before = envs.names()
    with pytest.raises(ValueError, match=message):
        envs.register(name, Line, time_limit=time_limit)
    assert envs.names() == before


@pytest.mark.usefixtures("registrations")
def test_what_is_made_must_be_an_environment():
    envs.register("nothing", lambda: {}, time_limit=1)
    with pytest.raises(ValueError, match=r"nothing must be an Env, a MujocoTask or .*, got dict"):
        envs.make("nothing")
    envs.register("task", lambda: Hopper(), time_limit=1)
    with pytest.raises(ValueError, match=r"task is a MuJoCo task: register it with engines=\('nat"):
        envs.make("task")


@pytest.mark.usefixtures("registrations")
@pytest.mark.parametrize("high", [np.inf, np.nan, 0.0, -1.0])
def test_actions_without_bounds_are_refused(high):
    class Unbounded(Line):
        action_high = np.asarray([high], np.float32)

    envs.register("unbounded", Unbounded, time_limit=1)
    with pytest.raises(
        ValueError, match=r"unbounded has actions of up to \[.*\]: action_high must"
    ):
        envs.make("unbounded")


def test_an_installed_package_names_an_environment(installed):
    module = installed(
        "moon",
        "import envs\n"
        "from envs.pendulum import Pendulum\n"
        "envs.register('moon', lambda g=1.6: Pendulum(g), time_limit=3)\n",
    )
    assert envs.names()[-1] == "moon"
    assert module not in sys.modules
    assert envs.spec("moon").time_limit == 3
    assert envs.make("moon").g == 1.6


def test_a_broken_package_is_named_and_breaks_nothing_else(installed):
    installed("broken", "import a_module_that_is_not_there\n")
    installed("silent", "")
    assert {"broken", "silent"} <= set(envs.names())
    assert envs.make("pendulum").g == 10
    with pytest.raises(ValueError, match=r"unknown environment 'brokn'; known are .*broken"):
        envs.spec("brokn")
    with pytest.raises(
        ValueError,
        match=r"'broken' of the package the-broken-package cannot be loaded: .*a_module_that_is",
    ):
        envs.spec("broken")
    with pytest.raises(
        ValueError,
        match=r"the-silent-package names .* 'silent', but importing silent_module does not regist",
    ):
        envs.make("silent")


# ----- what every environment does


@pytest.mark.usefixtures("their_code")
@pytest.mark.parametrize("name", ["pendulum", "driving", "hopper", "brax:fast"])
def test_actions_of_another_length_are_refused(name):
    env = envs.make(name)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    for wrong in (1, 4):
        if wrong == env.action_size:
            continue
        with pytest.raises(
            ValueError, match=rf"action must have shape \({env.action_size},\), got \({wrong},\)"
        ):
            jax.eval_shape(env.step, state, jnp.zeros(wrong))


def test_an_environment_without_a_drawing_says_so(tmp_path):
    with pytest.raises(NotImplementedError, match="Pendulum has no drawing of its episodes"):
        envs.make("pendulum").render([], None, tmp_path)
