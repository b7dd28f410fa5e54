"""The cockpit's page in a browser: what a person does is what the robot is asked, and the other way round.

Robots run in processes of their own, on twins, in real time; nothing here judges how fast the machine is.
What a robot cannot be made to say (hostile names, a recording that differs) is said by a server without one.
"""

from __future__ import annotations

import csv
import json
import os
import re
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from importlib import resources
from itertools import pairwise
from math import cos, exp, pi, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway import Goal, open_session
from gateway.view.access import Access, Address
from gateway.view.scene import QUANTITIES
from gateway.view.server import Server
from gateway.view.view import pages
from gateway.vision.camera import packed
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.processes import PATIENCE
from tests.gateway.view.chromium import Chromium, Tab, chromium, wait
from tests.gateway.view.test_view import PERIOD
from tests.gateway.view.test_view import bench as counted

PAGE = Path(__file__).parents[3] / "gateway" / "view" / "page"
WATCH = """
const clock = performance.now.bind(performance);
let newest = clock();
performance.now = () => Math.min(clock(), newest + 1000);
window.seen = { in: [], out: [], alive: 0, shift: 0 };
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", ({ data }) => {
      newest = clock();
      seen.in.push([newest, JSON.parse(typeof data === "string" ? data
        : new TextDecoder().decode(new Uint8Array(data, 4, new DataView(data).getUint32(0, true))))]);
    });
  }
  send(message) {
    if (message === "{}") seen.alive++;
    else seen.out.push([performance.now(), JSON.parse(message)]);
    super.send(message);
  }
};
window.addEventListener("pointerdown", ({ timeStamp }) => (seen.pressed = timeStamp), true);
let first = 0, last = 0, shift = 0;
new PerformanceObserver(list => list.getEntries().forEach(({ startTime, value }) => {
  if (startTime - last > 1000 || startTime - first > 5000) [first, shift] = [startTime, 0];
  [last, shift] = [startTime, shift + value];
  seen.shift = Math.max(seen.shift, shift);
})).observe({ type: "layout-shift", buffered: true });
"""
"""What came and went over the wire, with its time; how often the page said no more than that it is there;
and how much the layout has shifted, by web.dev's definition: the most in shifts that are less than 1 s apart
and within 5 s (the sum of all grows as long as a page is open). The page's clock goes no further than 1 s
beyond what came last: a busy machine is no silence of the robot, after which the page ends what is held."""


class Robot:
    """A robot in a process of its own: tests/gateway/view/robot.py."""

    def __init__(self, name: str, *words: str) -> None:
        command = [sys.executable, "-m", "tests.gateway.view.robot", name, *words]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()

    def do(self, line: str) -> Any:
        """Return the answer to a line."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(line, file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())

    def look(self) -> Any:
        """Return what it does."""
        return self.do("look")

    def asked(self, kind: str = "") -> list[str]:
        """Return what it was asked, but what is held."""
        return [one for _, one in self.look()["asked"] if one.startswith(kind)]

    def held(self, what: str) -> Any:
        """Wait until this is what was held last."""
        return wait(lambda: (seen := self.look()) and seen["held"][1].startswith(what) and seen, what)

    def stands(self) -> None:
        """Wait until it stands."""
        wait(lambda: standing(self.look()), "standing")

    def rest(self) -> None:
        """Have it stand without stop, fault or goal, whatever was before, near where it began; and forget
        what it was asked."""
        wait(
            lambda: (now := self.do("rest"))["state"] == "ready" and standing(now) and not now["far"], "rest"
        )
        self.do("forget")

    def end(self) -> None:
        """End it as one leaves a run."""
        self.process.communicate(timeout=PATIENCE)


def standing(seen: Any) -> bool:
    return all(abs(one) < 0.05 for one in seen["speeds"].values())


@contextmanager
def running(*words: str) -> Iterator[Robot]:
    robot = Robot(*words)
    try:
        yield robot
    finally:
        robot.end()


@pytest.fixture(scope="module")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with chromium(tmp_path_factory.mktemp("browser") / "profile") as one:
        yield one


@pytest.fixture
def browser(chrome: Chromium) -> Iterator[Chromium]:
    """Chromium, whose pages are closed after a test, and have complained of nothing."""
    yield chrome
    close_all(chrome)


def close_all(browser: Chromium) -> None:
    """Close its pages, which have complained of nothing."""
    browser.call("Browser.getVersion")  # and with its answer comes what is still under way
    problems = [problem for tab in browser.tabs.values() for problem in tab.problems]
    for tab in list(browser.tabs.values()):
        tab.close()
    assert problems == []


@pytest.fixture(scope="module")
def one_diffbot(chrome: Chromium) -> Iterator[Robot]:
    with running("diffbot", "steer") as robot:
        yield robot


@pytest.fixture
def diffbot(one_diffbot: Robot) -> Robot:
    """A robot that may be steered, standing, without stop, fault or goal."""
    one_diffbot.rest()
    return one_diffbot


@pytest.fixture(scope="module")
def one_bench(chrome: Chromium) -> Iterator[Robot]:
    with running("bench", "steer") as robot:
        yield robot


@pytest.fixture
def bench(one_bench: Robot) -> Robot:
    one_bench.rest()
    return one_bench


def opened(browser: Chromium, url: str, **size: int) -> Tab:
    """Return a page that shows a robot."""
    tab = browser.open(url, before=WATCH, **size)
    tab.until("document.querySelector('#word')?.dataset.state === 'ready'")
    tab.drawn()  # a pixel of the map is a place from then on
    return tab


def patient(tab: Tab) -> None:
    """Let what was pressed once be so until it is pressed again, however long that takes."""
    tab.run("void (window.setTimeout = () => 1)")


@pytest.fixture
def tab(browser: Chromium, diffbot: Robot) -> Tab:
    return opened(browser, diffbot.url)


def on_map(tab: Tab, x: float, y: float) -> tuple[float, float]:
    """Return the pixel so many m from where the robot is believed to be, which is the middle of the map."""
    left, top = tab.middle("#canvas")
    return left + 60 * x, top - 60 * y


def pose(tab: Tab) -> list[float]:
    found = re.findall(r"-?[\d.]+", tab.text("#pose"))
    return [float(one) for one in found[:2]]


def sent(tab: Tab, key: str) -> list[Any]:
    """Return what the page has sent under a key."""
    return [one[key] for one in tab.run("seen.out.map(one => one[1])") if key in one]


# -- steering ----------------------------------------------------------------------------------------


def test_a_click_on_the_map_is_a_goal_that_is_reached(tab: Tab, diffbot: Robot) -> None:
    x, y = pose(tab)
    at = on_map(tab, 0.5, 0.25)
    reached = (
        "[...document.querySelectorAll('#log li')].filter(one => one.textContent.includes('reached')).length"
    )
    before = tab.run(reached)  # the log has what other tests drove to
    tab.mouse("mousePressed", at)
    tab.mouse("mouseReleased", at)
    (goal,) = wait(lambda: diffbot.asked("Goal"), "a goal")
    numbers = [float(one) for one in re.findall(r"=(-?[\d.]+)", goal)]
    assert numbers == pytest.approx([x + 0.5, y + 0.25], abs=0.03)
    wait(lambda: diffbot.look()["pose"] == pytest.approx(numbers, abs=0.15), "the goal's place")
    tab.until(f"{reached} > {before}")
    diffbot.stands()
    assert diffbot.look()["pose"] == pytest.approx(numbers, abs=0.15)


def test_times_are_minutes_and_seconds_before_the_start_too(tab: Tab) -> None:
    times = "[[-10, 0], [-65, 2], [0, 0], [75.5, 2], [119.999, 0]].map(each => page.clock(...each))"
    shown = tab.run(f"import('./elements.js').then(page => {times})")
    assert shown == ["-0:10", "-1:05.00", "0:00", "1:15.50", "2:00"]


def test_a_drag_on_the_map_is_a_goal_with_a_heading(tab: Tab, diffbot: Robot) -> None:
    tab.mouse("mousePressed", on_map(tab, -0.3, 0.0))
    tab.mouse("mouseMoved", on_map(tab, -0.3, 0.5))
    tab.mouse("mouseReleased", on_map(tab, -0.3, 0.5))
    (goal,) = wait(lambda: diffbot.asked("Goal"), "a goal")
    assert "yaw=1.57" in goal
    tab.click("#drop")
    wait(lambda: diffbot.asked("Drop"), "giving it up")
    tab.mouse("mousePressed", on_map(tab, 0.3, 0.0))
    tab.key("keyDown", "Escape")
    tab.mouse("mouseReleased", on_map(tab, 0.3, 0.0))
    diffbot.stands()
    assert len(diffbot.asked("Goal")) == 1


def test_a_key_drives_as_long_as_it_is_held(tab: Tab, diffbot: Robot) -> None:
    tab.key("keyDown", "KeyW", "w")
    diffbot.held("Drive(linear=0.3, angular=0.0")
    tab.key("keyDown", "ArrowLeft")
    diffbot.held("Drive(linear=0.3, angular=1.0")
    tab.key("keyUp", "ArrowLeft")
    tab.key("keyUp", "KeyW", "w")
    diffbot.held("Drive(linear=0.0, angular=0.0")
    tab.key("keyDown", "KeyS", "s")
    diffbot.held("Drive(linear=-0.3")
    tab.run("window.dispatchEvent(new Event('blur'))")  # another window comes to the front
    diffbot.held("Drive(linear=0.0, angular=0.0")
    assert sent(tab, "held")[-1] == ""
    tab.key("keyUp", "KeyS", "s")
    diffbot.stands()


def event(name: str) -> str:
    """Return what an event does of which the browser thinks that it has to do with the page."""
    return f"document.body.dispatchEvent(new Event({name!r}, {{ bubbles: true }}))"


@pytest.mark.parametrize("what", ["contextmenu", "dragstart", "Cmd"])
def test_what_swallows_the_release_of_a_key_ends_what_is_held(
    browser: Chromium, fake: Fake, what: str
) -> None:
    tab = fake.show(browser, hello())
    tab.key("keyDown", "KeyW", "w")
    if what == "Cmd":
        tab.call("Input.dispatchKeyEvent", type="keyDown", code="MetaLeft", key="Meta", modifiers=4)
    else:
        tab.run(event(what))
    assert sent(tab, "held")[-2:] == ["drive 0.500 0.000 0.000", ""]


KEY_HAS_A_USE = [
    ("#log", "ArrowUp"), ("#rows", "ArrowDown"), ("#speed", "ArrowRight"), ("#line", "KeyW"),
    ("#span", "KeyS"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("where", "code"), [*KEY_HAS_A_USE, ("#speed", "KeyW"), ("#log", "KeyS"), ("#strafe", "KeyA")]
)
def test_a_key_drives_unless_it_has_a_use_where_the_focus_is(
    browser: Chromium, fake: Fake, where: str, code: str
) -> None:
    tab = fake.show(browser, hello())
    fake.say("settings", rows=[{"key": f"{number}", "value": 1.0, "file": 1.0} for number in range(20)])
    fake.until(lambda: tab.run("document.querySelector('#rows').children.length"))
    tab.run(f"document.querySelector('#settings').open = true, document.querySelector('{where}').focus()")
    assert tab.run(f"document.activeElement.matches('{where}')")
    tab.key("keyDown", code, code[-1].lower() if code.startswith("Key") else "")
    tab.key("keyUp", code, code[-1].lower() if code.startswith("Key") else "")
    assert bool(sent(tab, "held")) == ((where, code) not in KEY_HAS_A_USE)


def test_the_stick_drives_as_long_as_it_is_held(tab: Tab, diffbot: Robot) -> None:
    x, y = tab.middle("#stick")
    tab.mouse("mousePressed", (x, y))
    tab.mouse("mouseMoved", (x, y + 70))
    diffbot.held("Drive(linear=-0.3, angular=0.0")
    tab.mouse("mouseMoved", (x - 70, y))
    diffbot.held("Drive(linear=0.0, angular=1.0")
    tab.mouse("mouseReleased", (x - 70, y))
    diffbot.held("Drive(linear=0.0, angular=0.0")
    diffbot.stands()


def test_the_base_stands_after_the_page_has_vanished(browser: Chromium, diffbot: Robot) -> None:
    tab = opened(browser, diffbot.url)
    tab.key("keyDown", "ArrowRight")
    wait(lambda: abs(diffbot.look()["speeds"]["left"]) > 1.0, "turning")
    tab.close()
    diffbot.held("Drive(linear=0.0, angular=0.0")
    diffbot.stands()


# -- stop --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["click", "space bar", "space bar in a number", "Enter"])
def test_stop_is_heard_at_once_and_ends_what_is_held(tab: Tab, diffbot: Robot, how: str) -> None:
    tab.key("keyDown", "KeyD", "d")
    wait(lambda: diffbot.look()["speeds"]["left"] > 1.0, "turning")
    if how == "click":
        tab.click("#stop")
    elif how == "Enter":
        tab.run("document.querySelector('#stop').focus()")
        tab.call("Input.dispatchKeyEvent", type="keyDown", code="Enter", key="Enter", text="\r")
    else:
        field = "#settings summary" if how == "space bar" else "#rows input"
        tab.run(f"document.querySelector('#settings').open = true, document.querySelector('{field}').focus()")
        tab.key("keyDown", "Space", " ")
    tab.until("document.querySelector('#release').hidden === false")
    assert "an operator pressed STOP" in tab.text("#state")
    assert diffbot.asked() == ["Stop(reason='an operator pressed STOP')"]
    before, after = (diffbot.look()["stop"][when] for when in ("before", "after"))
    assert all(abs(after[name]) < abs(before[name]) for name in before)  # the tick that hears it brakes
    out, came, pressed = tab.run("[seen.out, seen.in, seen.pressed]")
    last = next(i for i, (_, one) in enumerate(out) if str(one.get("ask")).startswith("stop"))
    assert [one for _, one in out[last + 1 :]] == [{"held": ""}]  # the key is still down, in vain
    begin = pressed if how == "click" else out[last][0]
    noted = next(t for t, one in came if t > begin and str(one.get("text")).startswith("stopped: an op"))
    print(f"from STOP by {how} until the note of the tick that brakes: {noted - begin:.1f} ms")
    tab.key("keyUp", "KeyD", "d")
    diffbot.stands()
    patient(tab)
    tab.click("#release")
    assert diffbot.asked("Release") == []  # once is not enough
    tab.click("#release")
    tab.until("document.querySelector('#release').hidden")
    assert len(diffbot.asked("Release")) == 1


@pytest.mark.parametrize("why", [{"stop": True, "stopped": "another page"}, {"stopped": "left: a fault"}])
def test_a_stop_from_elsewhere_ends_what_is_held(browser: Chromium, fake: Fake, why: Any) -> None:
    tab = fake.show(browser, hello())
    tab.key("keyDown", "KeyW", "w")
    fake.until(lambda: fake.received)
    fake.say("state", **EMPTY | why)
    fake.until(lambda: fake.received[-1] == {"held": ""}, "the end of what is held")
    fake.say("state", **EMPTY)
    fake.until(lambda: tab.run("document.querySelector('#word').dataset.state === 'ready'"))
    assert sent(tab, "held")[-1] == ""  # the key is still down, in vain
    tab.key("keyUp", "KeyW", "w")
    tab.key("keyDown", "KeyW", "w")
    assert sent(tab, "held")[-1] == "drive 0.500 0.000 0.000"


def test_what_is_held_brings_the_gateways_newest_time_and_ends_once_that_is_too_old(
    browser: Chromium, fake: Fake
) -> None:
    tab = fake.show(browser, hello())
    drive = "drive 0.500 0.000 0.000"
    tab.key("keyDown", "KeyW", "w")
    for clock in (1234, 1300):
        fake.say_bytes({"kind": "signals", "clock": clock, "id": 0, "rows": 0}, b"")
        held = {"held": drive, "heard": clock}
        fake.until(partial(lambda held: fake.received[-1:] == [held], held), "its time")
    fake.say("answer", id=None, held=True, ok=False, text="the link is slow")
    fake.until(lambda: fake.received[-1] == {"held": ""}, "the end of what is held")
    assert tab.run("document.querySelector('#banner').checkVisibility()")
    assert tab.text("#banner") == "the link is slow"
    assert not tab.run("document.body.classList.contains('lost')")
    tab.key("keyUp", "KeyW", "w")
    tab.key("keyDown", "KeyW", "w")
    assert sent(tab, "held")[-1] == drive
    assert tab.run("document.querySelector('#banner').hidden")


def test_the_command_line_takes_spaces_and_answers(tab: Tab, diffbot: Robot) -> None:
    tab.run("document.querySelector('#line').focus()")
    for letter in "goal 1":
        tab.key("keyDown", "Space" if letter == " " else f"Key{letter.upper()}", letter)
    assert tab.run("document.querySelector('#line').value") == "goal 1"
    tab.type("#line", "help")
    tab.until("document.querySelector('#log').textContent.includes('drive to a place on the map')")
    tab.type("#line", "gaol 1 2")
    tab.until("document.querySelector('#log .refused')?.textContent.includes(\"did you mean 'goal'\")")
    tab.key("keyDown", "ArrowUp")
    assert tab.run("document.querySelector('#line').value") == "gaol 1 2"
    assert diffbot.asked() == []


def test_space_stops_once_a_line_was_sent(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    tab.type("#line", "status")
    assert tab.run("document.activeElement.id") == "line"
    tab.key("keyDown", "Space", " ")
    assert sent(tab, "ask") == ["status", "stop an operator pressed STOP"]
    assert tab.run("document.querySelector('#line').value") == ""


# -- what is shown -----------------------------------------------------------------------------------


def test_a_fault_is_shown_with_its_cause_and_remedy_and_cleared(tab: Tab, diffbot: Robot) -> None:
    fault = diffbot.do("provoke left")
    tab.until("document.querySelector('#faults article')")
    shown = tab.text("#faults")
    assert all(one in shown for one in (fault["name"], fault["cause"], fault["remedy"]))
    assert tab.text("#to-faults") == "1 fault"
    wait(lambda: fault["name"] in tab.text("#state"), "the fault as the reason")
    tab.click("#faults article button")
    tab.until("document.querySelector('#faults').textContent === 'none'")
    tab.until("document.querySelector('#word').textContent === 'ready'")
    assert diffbot.asked() == ["ClearFault(motor='left')"]


def test_a_setting_is_changed_and_its_value_seen_back(tab: Tab, diffbot: Robot) -> None:
    tab.run("document.querySelector('#settings').open = true")
    tab.type("#filter", "pursuit.turn_gain", enter=False)
    assert tab.run("[...document.querySelectorAll('#rows form')].filter(one => !one.hidden).length") == 1
    row = "#rows form:not([hidden])"
    in_file = tab.run(f"document.querySelector('{row} input').value")
    tab.type(f"{row} input", "1.25")
    tab.until(f"document.querySelector('{row} output').textContent === 'now 1.25'")
    tab.until(f"document.querySelector('{row}').classList.contains('changed')")
    assert diffbot.asked("Set")[-1] == "Set(key='brain.pursuit.turn_gain', value=1.25)"
    tab.type(f"{row} input", "-3")
    tab.until(f"document.querySelector('{row} output').className === 'bad'")
    tab.until(f"document.querySelector('{row} input').value === '1.25'")
    tab.click(f"{row} button[title]")
    tab.until(f"document.querySelector('{row} input').value === '{in_file}'")
    tab.type("#filter", "left.limits.velocity", enter=False)
    tab.type(f"{row} input", "99")  # more than the robot file allows: the browser tells, and nothing is sent
    assert not tab.run(f"document.querySelector('{row} input').validity.valid")
    assert len([line for line in sent(tab, "ask") if line.startswith("set ")]) == 3
    wait(lambda: len(diffbot.asked("Set")) == 3, "the robot hears of all three")


def test_settings_are_filtered_by_words_with_commas_between_them(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    keys = ["pursuit.turn_gain", "pursuit.corner", "follow.corner"]
    fake.say("settings", rows=[{"key": key, "value": 1.0, "file": 1.0} for key in keys])
    tab.until("document.querySelector('#rows').children.length === 3")
    tab.run("document.querySelector('#settings').open = true")
    tab.type("#filter", "pursuit,corner", enter=False)  # a space would be a stop
    shown = "[...document.querySelectorAll('#rows form:not([hidden]) .key')].map(one => one.textContent)"
    assert tab.run(shown) == ["pursuit.corner"]


def test_samples_come_as_often_as_the_loop_allows(tab: Tab, diffbot: Robot) -> None:
    at = on_map(tab, -0.5, 0.0)  # behind it: as it turns, the map changes
    tab.mouse("mousePressed", at)
    tab.mouse("mouseReleased", at)
    first = wait(lambda: (seen := diffbot.look())["state"] == "running" and seen, "driving")
    last = wait(lambda: (seen := diffbot.look())["tick"] > first["tick"] + 300 and seen, "300 ticks")
    tab.until(f"seen.in.at(-1)[1].t > {last['t']}")
    came = [one for _, one in tab.run("seen.in")]
    ticks, span = last["tick"] - first["tick"], last["t"] - first["t"]
    print(f"of {ticks / span:.0f} ticks a second, to the page each second:", end=" ")
    signals = [one["rows"] for one in came if one["kind"] == "signals" and first["t"] < one.get("t", 0.0)]
    assert sum(signals) >= ticks - 40  # every tick of what is plotted, but what is under way
    for kind, every in (("joints", 20), ("state", 20)):
        times = [one["t"] for one in came if one["kind"] == kind and first["t"] < one["t"] <= last["t"]]
        print(f"{len(times) / span:.0f} {kind}", end=" ")
        assert times == sorted(times)
        assert len(times) >= ticks / every - 2
    driving = [
        i for i, one in enumerate(came) if one["kind"] == "state" and first["t"] < one["t"] <= last["t"]
    ]
    for kind in ("scan", "tiles"):  # every 100 ms of the loop's time, if new
        count = [one["kind"] for one in came[driving[0] : driving[-1]]].count(kind)
        print(f"{count / span:.0f} {kind}", end=" ")
        assert count >= 0.5 * span / 0.1 - 2


def test_everything_can_be_reached_and_has_a_name(tab: Tab) -> None:
    tab.run("document.querySelector('#settings').open = true")
    nodes = tab.call("Accessibility.getFullAXTree")["nodes"]
    kinds = {
        "button",
        "textbox",
        "searchbox",
        "spinbutton",
        "slider",
        "combobox",
        "link",
        "checkbox",
        "log",
        "status",
    }
    named = [(one["role"]["value"], one.get("name", {}).get("value", "")) for one in nodes if "role" in one]
    assert [one for one in named if one[0] in kinds - {"status"} and not one[1]] == []
    assert {role for role, _ in named} >= {"button", "slider", "spinbutton", "log", "status"}
    assert tab.run("seen.shift") < 0.1  # what web.dev calls good


@pytest.mark.parametrize("robot", ["diffbot", "bench"])
def test_a_phone_shows_stop_always_and_nothing_beside_the_screen(
    browser: Chromium, request: pytest.FixtureRequest, robot: str
) -> None:
    tab = opened(browser, request.getfixturevalue(robot).url, width=390, height=844)
    for where in (0, 700, 100000):
        tab.run(f"window.scrollTo(0, {where})")
        box = tab.run(
            "(b => [b.left, b.right, b.top, b.bottom])"
            "(document.querySelector('#stop').getBoundingClientRect())"
        )
        assert 0 <= box[0] < box[1] <= 390
        assert 844 - 120 < box[2] < box[3] <= 844
    assert tab.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


def phone(tab: Tab, width: int = 390) -> None:
    """Have a page on a phone."""
    size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    tab.call("Emulation.setDeviceMetricsOverride", **size)
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True)
    tab.until(f"innerWidth === {width}")


def test_stop_stands_above_what_covers_a_phone_s_screen(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    phone(tab)
    tab.until("document.querySelector('#stop').getBoundingClientRect().bottom > 800")
    tab.call(
        "Emulation.setPageScaleFactor", pageScaleFactor=2
    )  # as a keyboard does: less of the page is seen
    tab.until("visualViewport.height < 500")
    tab.until(
        "(({ top, bottom }, { offsetTop, height }) => top > offsetTop && bottom <= offsetTop + height)"
        "(document.querySelector('#stop').getBoundingClientRect(), visualViewport)"
    )


def test_a_phone_does_not_zoom_into_a_field(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello(joints=["arm"]))
    phone(tab)
    sizes = "[...document.querySelectorAll('input, select')].map(one => getComputedStyle(one).fontSize)"
    tab.until(f"{sizes}.every(size => size === '16px')")  # less, and iOS zooms


def test_a_finger_moves_the_map_unless_a_goal_is_to_be_set(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    phone(tab)
    tab.until("document.querySelector('#aim').offsetWidth")
    x, y = tab.middle("#canvas")
    tab.touch((x, y))
    tab.touch((x, y + 60))
    tab.touch()
    assert (
        tab.run("document.querySelector('#follow').getAttribute('aria-pressed')") == "false"
    )  # it has moved
    assert sent(tab, "ask") == []
    tab.run("document.querySelector('#aim').click()")
    tab.touch((x, y))
    tab.touch()
    (goal,) = sent(tab, "ask")
    assert [float(one) for one in goal.split()[1:]] == pytest.approx([0.0, 1.0], abs=0.02)
    assert (
        tab.run("document.querySelector('#aim').getAttribute('aria-pressed')") == "false"
    )  # it was one goal
    tab.touch((x, y))
    tab.touch()
    assert len(sent(tab, "ask")) == 1


def test_on_a_phone_the_page_scrolls_beside_the_map(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    phone(tab)
    right = "document.querySelector('#canvas').getBoundingClientRect().right"
    tab.until(f"innerWidth === 390 && {right} > 300 && {right} < 390 - 44")  # a finger's breadth


def test_a_long_name_leaves_room_for_the_state(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello("robot_of_the_second_floor_kitchen_2"), width=360)
    assert tab.run("document.querySelector('#state').offsetWidth") > 120
    later(tab, 2.0)
    tab.until("!document.querySelector('#banner').hidden")
    box = "document.querySelector('{}').getBoundingClientRect().{}"
    assert tab.run(f"{box.format('#banner', 'top')} - {box.format('header', 'bottom')}") == 0.0


@pytest.mark.parametrize("width", [320, 390, 768, 1024])
def test_nothing_is_wider_than_the_window(browser: Chromium, fake: Fake, width: int) -> None:
    tab = fake.show(browser, hello(joints=["shoulder", "elbow"], base=False), width=width)
    assert tab.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    right = "getBoundingClientRect().right"
    assert tab.run(
        f"[...document.querySelectorAll('.joint')].every(one => one.{right} <= one.closest('.panel').{right})"
    )


def test_bare_joints_are_moved_by_hand(browser: Chromium, bench: Robot) -> None:
    tab = opened(browser, bench.url)
    assert tab.run("document.querySelector('#map').hidden && document.querySelector('#drive').hidden")
    tab.until("document.querySelectorAll('.joint').length === 2")
    for row in (1, 2):
        tab.click(f".joint:nth-of-type({2 * row - 1}) .open")
    right = ".more:nth-of-type(4)"
    tab.until(f"document.querySelector('{right} .hold').checkVisibility()")
    at = tab.middle(f"{right} .hold:nth-of-type(2)")
    tab.mouse("mousePressed", at)
    bench.held("Velocity(motor='right', velocity=2.0")
    wait(lambda: bench.look()["speeds"]["right"] > 1.0, "turning")
    tab.mouse("mouseReleased", at)
    bench.held("Velocity(motor='right', velocity=0.0")
    bench.stands()
    tab.run(
        f"(one => {{ one.value = 'torque'; one.dispatchEvent(new Event('change')); }})"
        f"(document.querySelector('{right} select'))"
    )
    tab.type(f"{right} [type=number]", "0.05", enter=False)
    at = tab.middle(f"{right} .hold")
    tab.mouse("mousePressed", at)
    bench.held("Torque(motor='right', torque=-0.05")
    tab.mouse("mouseReleased", at)
    bench.held("Torque(motor='right', torque=0.0")
    tab.type(".more input.to", "0.5")
    position = "document.querySelector('.joint [title=\"plot position of left\"]').textContent"
    tab.until(f"{position}.startsWith('0.5')")
    patient(tab)
    button = "[...document.querySelectorAll('.more .controls button')].find(one => one.textContent === '{}')"
    tab.run(f"{button.format('Zero …')}.click()")
    tab.run(f"{button.format('Press again')}.click()")
    wait(lambda: bench.asked("Zero"), "zero")
    assert bench.asked("Zero")[0] == "Zero(motor='left')"


def test_a_step_on_a_bench_is_held_plotted_and_measured(browser: Chromium, bench: Robot) -> None:
    tab = opened(browser, bench.url)
    tab.until("document.querySelectorAll('.joint').length === 2")
    tab.click(".joint .open")
    step = ".more .hold:nth-of-type(3)"
    tab.until(f"document.querySelector('{step}').checkVisibility()")
    at = tab.middle(step)
    tab.mouse("mousePressed", at)
    bench.held("Velocity(motor='left', velocity=0.0")
    bench.held("Velocity(motor='left', velocity=2.0")
    wait(lambda: bench.look()["speeds"]["left"] > 1.9, "turning")
    now = bench.look()["t"]
    wait(lambda: bench.look()["t"] > now + 0.5, "turning for a while")
    tab.mouse("mouseReleased", at)
    bench.held("Velocity(motor='left', velocity=0.0")
    tab.until("document.querySelector('.controls output').textContent.includes('overshoot')")
    found = tab.run("document.querySelector('.controls output').textContent")
    assert found.startswith("velocity step: 10 % after ")
    assert {"left velocity command", "left velocity"} <= set(tab.run(SHOWN))
    assert tab.run("document.querySelector('#pause').textContent") == "Follow"
    tab.type(".more input.to", "0.4", enter=False)
    tab.run("document.querySelector('.more .to ~ button:nth-of-type(2)').click()")
    tab.until("document.querySelector('.controls output').textContent.startsWith('position step: 10 %')")
    assert bench.asked("Position")[0].startswith("Position(motor='left'")


def test_the_figures_of_a_step_are_those_of_a_second_order_system(browser: Chromium, fake: Fake) -> None:
    """Damping 0.4 at 20 rad/s: overshoot exp(-pi d / sqrt(1 - d²)), and the times by its closed form."""
    tab = fake.show(browser, hello(base=False))
    d, w = 0.4, 20.0
    wd = w * sqrt(1.0 - d * d)
    times = [0.001 * i for i in range(2500)]
    answer = [
        2.0 * (1.0 - exp(-d * w * (t - 0.5)) * (cos(wd * (t - 0.5)) + d * w / wd * sin(wd * (t - 0.5))))
        if t > 0.5
        else 0.0
        for t in times
    ]
    command = [2.0 if t >= 0.5 else 0.0 for t in times]
    found = tab.run(
        f"import('./steps.js').then(m => m.figures({times}, {command}, {[one + 1.0 for one in answer]}))"
    )
    after = [(t - 0.5, one / 2.0) for t, one in zip(times, answer, strict=True) if t > 0.5]
    reached = [next(t for t, one in after if one >= share) for share in (0.1, 0.9)]
    assert found["overshoot"] == pytest.approx(exp(-pi * d / sqrt(1.0 - d * d)), abs=1e-3)
    assert found["delay"] == pytest.approx(reached[0], abs=0.002)
    assert found["rise"] == pytest.approx(reached[1] - reached[0], abs=0.002)
    outside = [t for t, one in after if abs(one - 1.0) > 0.05]
    assert found["settled"] == pytest.approx(outside[-1], abs=0.003)
    assert found["error"] == pytest.approx(-1.0, abs=1e-3)
    assert found["noise"] == pytest.approx(0.0, abs=1e-3)
    still = f"import('./steps.js').then(m => m.figures({times}, {command}, {[0.01] * len(times)}))"
    assert tab.run(still) is None


def test_a_parameter_of_a_device_is_read(browser: Chromium, bench: Robot) -> None:
    tab = opened(browser, bench.url)
    tab.until("document.querySelectorAll('.joint').length === 2")
    tab.click(".joint .open")
    tab.until("document.querySelector('.parameters').checkVisibility()")
    tab.type(".parameters input", "Bus_Voltage")
    tab.until("document.querySelector('#log').textContent.includes('Bus_Voltage')")
    assert bench.asked("ReadParameter")[0].endswith("'Bus_Voltage')")


# -- three dimensions, cameras -----------------------------------------------------------------------

RED, GREEN, BLUE = (f"{one} > 100 && {two} < 10 && {three} < 10" for one, two, three in ("rgb", "grb", "brg"))
YELLOW = "r > 220 && g > 180 && b < 60"


def pixels(tab: Tab, canvas: str, colour: str) -> list[float]:
    """Return how many pixels of a canvas are of a colour (what is true of r, g, b), and the middle of these,
    from 0 to 1 from the left and from the top."""
    script = f"""(canvas => {{
      const {{ width, height }} = canvas, seen = [0, 0, 0];
      const pen = new OffscreenCanvas(width, height).getContext("2d");
      pen.drawImage(canvas, 0, 0);
      const data = pen.getImageData(0, 0, width, height).data;
      for (let i = 0; i < data.length; i += 4) {{
        const [r, g, b] = data.subarray(i, i + 3);
        if (!({colour})) continue;
        seen[0]++;
        seen[1] += ((i / 4) % width) / width;
        seen[2] += Math.floor(i / 4 / width) / height;
      }}
      return [seen[0], seen[1] / (seen[0] || 1), seen[2] / (seen[0] || 1)];
    }})(document.querySelector({canvas!r}))"""
    tab.drawn()
    found: list[float] = tab.run(script)
    return found


def solid(kind: str, size: list[float], at: list[float], colour: list[int], **more: int) -> Any:
    return {"kind": kind, "size": size, "at": [*at, 0, 0, 0], "colour": colour} | more


def part(carrier: int, at: list[float], *shapes: Any, motor: str = "") -> Any:
    where = {"carrier": carrier, "at": [*at, 0, 0, 0], "axis": [1, 0, 0], "slides": False, "rest": 0.0}
    return where | {"motor": motor, "shapes": list(shapes)}


def test_a_figure_moves_as_its_joints_do_and_is_turned_by_a_person(browser: Chromium, fake: Fake) -> None:
    """A red bar stands on a blue base; its joint turns it about x, which looks to the left and forward."""
    bar = part(0, [0, 0, 0.2], solid("cylinder", [0.05, 0.8], [0, 0, 0.4], [1, 0, 0]), motor="arm")
    parts = [part(-1, [0, 0, 0], solid("box", [0.4, 0.4, 0.2], [0, 0, 0.1], [0, 0, 1])), bar]
    about = hello(joints=["arm"], base=False) | {"figure": parts, "missing": ["a.dae: only STL is drawn"]}
    tab = fake.show(browser, about)
    row = ["armed", True, "Position", 0.0, 0.0, 0.0, 0.0, 1.0, 24.0, 30.0, 3, 0]

    def red(angle: float | None) -> list[float]:
        fake.say("joints", t=1.0, rows=[row], figure=[angle])
        value = "arm –" if angle is None else f"arm {angle:.2f} rad"
        names = "document.querySelector('#figure-names').textContent"
        drawn = "new Promise(requestAnimationFrame).then(() => requestAnimationFrame)"
        fake.until(lambda: tab.run(f"{drawn}.then(() => {names} === {json.dumps(value)})"))
        return pixels(tab, "#figure-canvas", RED)

    assert tab.run("document.querySelector('#figure').open")
    assert "a.dae: only STL is drawn" in tab.text("#figure-panel")
    tab.click("#figure-values")
    unknown = red(None)
    assert unknown[0] > 100
    up = red(0.0)
    assert up == pytest.approx(unknown, abs=1e-6)  # at rest
    aside = red(-1.57)
    assert abs(aside[1] - up[1]) > 0.05
    assert aside[2] > up[2] + 0.05  # lower
    x, y = tab.middle("#figure-canvas")
    tab.mouse("mousePressed", (x, y))
    tab.mouse("mouseMoved", (x + 150, y))
    tab.mouse("mouseReleased", (x + 150, y))
    turned = pixels(tab, "#figure-canvas", RED)
    assert turned != pytest.approx(aside, rel=0.03)
    before = pixels(tab, "#figure-canvas", BLUE)[0]
    tab.click("#figure-far")
    assert pixels(tab, "#figure-canvas", BLUE)[0] < 0.8 * before


def test_a_mesh_is_drawn_piece_by_piece(browser: Chromium, fake: Fake) -> None:
    mesh = solid("mesh", [0.5, 0.5, 0.5], [0, 0, 0], [0, 1, 0], mesh=0)
    base = solid("box", [0.1, 0.1, 0.1], [0, 0, 0.05], [0, 0, 1])
    tab = fake.show(browser, hello(base=False) | {"figure": [part(-1, [0, 0, 0], base, mesh)], "missing": []})
    seen = [pixels(tab, "#figure-canvas", GREEN)[0]]
    assert seen == [0]
    for first in (0, 20000):
        corners = ((first, 0, 65535), (first + 20000, 0, 65535), (first, 60000, 65535))
        data = struct.pack("<9H", *(one for corner in corners for one in corner))
        header = {"kind": "mesh", "mesh": 0, "low": [-0.5, -0.5, 0.0], "step": 1 / 65535, "count": 1}
        fake.say_bytes(header, data)
        fake.until(lambda: pixels(tab, "#figure-canvas", GREEN)[0] > seen[-1])
        seen.append(pixels(tab, "#figure-canvas", GREEN)[0])


def test_a_camera_s_markers_are_drawn_where_they_are_in_its_picture(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    marker = {"t": 1.0, "marker": 7, "at": [0.35, 0.265], "distance": 2.0, "face": [0.34, 0.265]}
    fake.say("camera", t=1.05, cameras=[{"name": "eye", "seen": [marker, {"t": 0.9, "marker": None}]}])
    fake.until(lambda: tab.run("document.querySelector('#cameras canvas') !== null"))
    count, x, y = pixels(tab, "#cameras canvas", YELLOW)
    assert count > 50
    assert (x, y) == pytest.approx((0.25, 0.25), abs=0.12)  # half to the left, half up; its name beside it
    assert tab.text("#cameras").endswith("7 at 2.00 m")
    picture = packed(np.full((480, 640, 3), (0, 0, 255), dtype=np.uint8), 320, 50)
    header = {"kind": "picture", "name": "eye", "t": 1.0, "wide": 0.7, "tall": 0.53}
    fake.say_bytes(header, picture)
    fake.until(lambda: pixels(tab, "#cameras canvas", "b > 200 && r < 40 && g < 40")[0] > 200_000)
    assert pixels(tab, "#cameras canvas", YELLOW)[1:] == pytest.approx([x, y], abs=0.02)
    fake.say("camera", t=9.0, cameras=[{"name": "eye", "seen": []}])
    fake.until(lambda: tab.text("#cameras").endswith("no image reported for 2 s"))


# -- plots -------------------------------------------------------------------------------------------

SHOWN = (
    "[...document.querySelectorAll('.signal')].map(one => one.textContent.split(' ').slice(0, -3).join(' '))"
)
"""The signals of the plot, by their joints and quantities."""


def plotting(browser: Chromium, fake: Fake, joints: int = 3) -> Tab:
    """Return a page that plots the age and the velocity of a joint: 10 s of a sine, a tick each 5 ms."""
    tab = fake.show(browser, hello(joints=[f"joint{number}" for number in range(joints)], base=False))
    for joint in ("joint0", "joint1"):
        assert tab.run(SHOWN)[:2] == [f"{joint} velocity command", f"{joint} velocity"]
        for _ in range(2):
            tab.run("document.querySelector('.signal').click()")
    assert tab.run(SHOWN) == []
    assert tab.run("document.querySelector('#no-signals').checkVisibility()")
    for quantity in ("age", "velocity"):
        tab.run(f"document.querySelector('[title=\"plot {quantity} of joint1\"]').click()")
    asked = fake.until(lambda: chosen(fake, [["joint1", "age"], ["joint1", "velocity"]]), "the choice")
    rows = [(number * 0.005, number % 5, sin(number * 0.005)) for number in range(2001)]
    data = struct.pack(f"<{3 * len(rows)}f", *(value for row in rows for value in row))
    fake.say_bytes({"kind": "signals", "clock": 0, "id": asked["id"], "t": 100.0, "rows": len(rows)}, data)
    fake.until(lambda: tab.run("document.querySelector('#plot-time').textContent === '1:50.00'"))
    return tab


def chosen(fake: Fake, signals: list[list[str]]) -> Any:
    """Return the newest choice of what is plotted, once it is this."""
    asked = [one["plot"] for one in fake.received if "plot" in one]
    return asked and asked[-1]["signals"] == signals and asked[-1]


def saved(tab: Tab, folder: Path) -> list[list[str]]:
    """Press CSV, and return the rows of the file."""
    for old in folder.glob("*.csv"):
        old.unlink()
    tab.chromium.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    tab.click("#csv")
    file = wait(lambda: next(folder.glob("*.csv"), None), "a file")
    wait(lambda: file.read_bytes().endswith(b"\r\n"), "all of it")
    return list(csv.reader(file.read_bytes().decode().splitlines()))


def test_what_is_plotted_is_zoomed_read_at_a_cursor_and_saved(
    browser: Chromium, fake: Fake, tmp_path: Path
) -> None:
    tab = plotting(browser, fake)
    assert tab.run(SHOWN) == ["joint1 age", "joint1 velocity"]
    pressed = "[...document.querySelectorAll('.joint [aria-pressed=true]')].map(one => one.title)"
    assert tab.run(pressed) == ["plot velocity of joint1", "plot age of joint1"]
    rows = saved(tab, tmp_path)
    assert rows[0] == ["t [s]", "joint1 age [ms]", "joint1 velocity [rad/s]"]
    assert len(rows) == 1 + 2001
    assert [float(one) for one in rows[-1]] == pytest.approx([110.0, 0, sin(10.0)], abs=1e-4)

    x, y = tab.middle("#plot .u-over")
    tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)  # the middle of 20 s: 100.0
    tab.until("document.querySelector('#plot-time').textContent.startsWith('1:40.0')")
    newest = tab.run("[...document.querySelectorAll('.signal .num')].map(one => one.textContent)")
    assert float(newest[1]) == pytest.approx(0.0, abs=0.1)
    width = tab.run("document.querySelector('#plot .u-over').clientWidth")
    tab.select((x + width / 4, y), (x + width * 3 / 8, y))  # 105 to 107.5 s
    tab.until("document.querySelector('#pause').textContent === 'Follow'")
    rows = saved(tab, tmp_path)
    seen = [float(row[0]) for row in rows[1:]]
    assert [seen[0], seen[-1]] == pytest.approx([105.0, 107.5], abs=0.2)
    tab.run("document.querySelector('#pause').click()")
    assert tab.text("#pause") == "Pause"
    assert len(saved(tab, tmp_path)) == 1 + 2001
    tab.run("document.querySelector('#span').value = 5")
    tab.run("document.querySelector('#span').dispatchEvent(new Event('change'))")
    assert len(saved(tab, tmp_path)) == 1 + 1001


def test_a_signal_that_is_added_has_its_past_from_the_rows_of_the_last_minute(
    browser: Chromium, fake: Fake, tmp_path: Path
) -> None:
    tab = plotting(browser, fake)
    row = ["armed", True, "Velocity", 1.0, 0.5, 0.25, 0.125, 1.0, 24.0, 30.0, 3, 0]
    for tenth in range(101):
        fake.say("joints", t=100.0 + tenth / 10, rows=[row, [*row[:5], tenth, *row[6:]], row])
    fake.until(lambda: tab.run("document.querySelector('.joint .chip').textContent === 'armed'"))
    tab.run("document.querySelector('[title=\"plot torque of joint2\"]').click()")
    rows = saved(tab, tmp_path)
    assert rows[0][3] == "joint2 torque [N·m]"
    assert {one[3] for one in rows[1:]} == {"0.125"}
    first = tab.run("[...document.querySelectorAll('.more .value')].map(one => one.textContent)")
    assert "velocity error 0.75" in first
    assert "velocity command 1.00" in first


def test_after_a_jump_back_what_was_later_is_not_plotted_any_more(
    browser: Chromium, fake: Fake, tmp_path: Path
) -> None:
    tab = plotting(browser, fake)
    asked = [one["plot"] for one in fake.received if "plot" in one][-1]
    again = {"kind": "signals", "clock": 0, "id": asked["id"], "t": 104.0, "rows": 1}
    fake.say_bytes(again, struct.pack("<3f", 0.0, 9.0, 9.0))
    tab.until("document.querySelector('#plot-time').textContent === '1:44.00'")
    stale = {"kind": "signals", "clock": 0, "id": asked["id"] - 1, "t": 105.0, "rows": 1}
    fake.say_bytes(stale, struct.pack("<3f", 0.0, 9.0, 9.0))  # of another choice: no rows of this plot
    rows = saved(tab, tmp_path)
    assert len(rows) == 1 + 801
    assert [float(one) for one in rows[-1]] == [104.0, 9.0, 9.0]


DRAWN = """
window.drawn = [];
let given;
Object.defineProperty(window, "uPlot", { configurable: true, get: () => given, set(uPlot) {
  given = new Proxy(uPlot, { construct(target, how) {
    const plot = new target(...how), set = plot.setData;
    let before = 0;
    plot.setData = (data, ...rest) => {
      before = clock();
      drawn.push([data[0].length, data[0].at(-1), 0]);
      set.call(plot, data, ...rest);
    };
    const took = () => drawn.length && (drawn.at(-1)[2] = clock() - before); // it draws in a microtask
    (plot.hooks.draw ??= []).push(took);
    return (window.plotted = plot);
  } });
} });
"""
"""Notes of each time a plot is drawn: how much it has, its newest time, and how long that took [ms]."""


@pytest.mark.parametrize("seconds", [6, pytest.param(60, marks=pytest.mark.prove)])
def test_every_tick_of_a_plot_at_200_hz_is_drawn_with_the_next_frame(browser: Chromium, seconds: int) -> None:
    """Counted, not timed: each tenth of a second, in which five messages come, the page is given a frame, and
    its plot ends where the newest message does."""
    with counted(steer=False) as loop:
        tab = browser.open(loop.view.url, before=WATCH + DRAWN)
        while not loop.view._server.clients:  # it answers nothing until it is there
            loop.tick()

        def until(script: str, tick: int = 0) -> None:
            """Wait, while both ends go on: the loop by so many ticks."""

            def seen() -> bool:
                loop.run(tick * PERIOD / SECOND)
                loop.view.poll(loop.now)
                loop.view.show(loop.now)
                return bool(tab.run(f"Boolean({script})"))

            wait(seen, script)

        until("window.plotted?.series.length === 5 && drawn.length > 2", tick=4)
        tab.run("document.querySelector('#span').value = '60'")
        begin, late = loop.now, 0
        newest = "seen.in.findLast(([, one]) => one.kind === 'signals')[1].clock"
        for _ in range(10 * seconds):
            loop.run(0.1)
            until(f"{newest} >= {loop.now // MILLISECOND - 20}")
            tab.drawn()
            late += not tab.run(f"1000 * drawn.at(-1)[1] > {newest} - 5")
        ticks = (loop.now - begin) // PERIOD
        times = tab.run("plotted.data[0]")
        came = "seen.in.reduce((sum, [, one]) => sum + (one.kind === 'signals' && one.id ? one.rows : 0), 0)"
        cost = sorted(tab.run("drawn.map(one => one[2])"))
        print(
            f"{ticks} ticks: {tab.run(came)} rows came, {len(times)} are drawn, in {len(cost)} frames of "
            f"{cost[len(cost) // 2]:.1f} ms (median), at most {cost[-1]:.1f} ms; {late} late"
        )
        assert late == 0
        assert {round(after - before, 4) for before, after in pairwise(times[-ticks + 20 :])} == {0.005}
        assert tab.run("document.querySelector('#plot-lost').textContent") == ""
        tab.close()


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_twelve_joints_and_their_plot_fill_no_more_than_a_screen_and_a_half(
    browser: Chromium, fake: Fake, width: int, height: int
) -> None:
    tab = fake.show(browser, hello(joints=[f"rear_{n}_knee" for n in range(12)], base=False), width=width)
    row = ["initialising", True, "Velocity", -12.345, -12.345, -12.34, -12.345, 1.0, 24.0, 30.0, 3, 0]
    fake.say("joints", t=1.0, rows=[row] * 12)
    tab.until("document.querySelector('.joint .chip').textContent === 'initialising, armed'")
    box = "document.querySelector('{}').getBoundingClientRect()"
    tall = tab.run(f"{box.format('#plot')}.bottom - {box.format('#joints-panel')}.top")
    assert tall < 1.5 * height
    scrolled = "document.querySelector('#joints-panel .scroll')"
    assert tab.run(f"{scrolled}.scrollWidth <= {scrolled}.clientWidth")
    assert tab.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


@pytest.mark.parametrize("second", ["finger", "Enter"])
def test_a_button_that_is_pressed_twice_ends_what_it_holds(
    browser: Chromium, fake: Fake, second: str
) -> None:
    tab = fake.show(browser, hello(joints=["arm"], base=False))
    tab.run("document.querySelector('.open').click()")
    x, y = tab.middle(".hold:nth-of-type(2)")
    tab.touch((x, y))
    if second == "finger":
        tab.touch((x, y), (x + 8, y))
        tab.touch((x, y))
    else:
        tab.run("document.querySelector('.hold:nth-of-type(2)').focus()")
        tab.key("keyDown", "Enter", "Enter")
        tab.key("keyUp", "Enter", "Enter")
    tab.touch()
    assert sent(tab, "held")[0].startswith("velocity arm 0.1")
    assert sent(tab, "held")[-1] == ""
    assert tab.run("document.querySelector('.held') === null")


def test_without_steer_a_page_can_only_look_and_stop(browser: Chromium) -> None:
    with running("diffbot") as robot:
        tab = opened(browser, robot.url)
        assert tab.run("document.querySelector('#drive').hidden && document.querySelector('#record').hidden")
        at = on_map(tab, 0.5, 0.0)
        tab.mouse("mousePressed", at)
        tab.mouse("mouseReleased", at)
        tab.key("keyDown", "KeyW", "w")
        tab.key("keyUp", "KeyW", "w")
        assert {key for one in tab.run("seen.out.map(one => one[1])") for key in one} == {"plot"}
        tab.type("#line", "goal 1 1")
        tab.until("document.querySelector('#log .refused')?.textContent.includes('read-only')")
        tab.click("#stop")
        tab.until("document.querySelector('#word').textContent === 'stopped'")
        assert tab.run("document.querySelector('#release').hidden")
        assert robot.asked() == ["Stop(reason='an operator pressed STOP')"]
        tab.close()


# -- recordings --------------------------------------------------------------------------------------


FRAMES = "[...document.querySelectorAll('iframe')].map(frame => frame.contentDocument)"


@contextmanager
def beside(folder: Path, *drives: tuple[Goal, float], change: str = "") -> Iterator[str]:
    """Record drives to a goal of so many s, and yield where they are shown beside each other.

    The goal is asked for after a quarter of it. `change`: of the robot file that they are played with."""
    files = [f"drive{number}.mcap" for number, _ in enumerate(drives, 1)]
    for (goal, seconds), file in zip(drives, files, strict=True):
        with open_session("diffbot", simulated=True, record=folder / file) as session:
            for tick in session.run(seconds=seconds):
                if tick.number == int(seconds / 4 / session.robot.period * SECOND):
                    session.submit(goal)
    own = resources.files("fixtures") / "robots" / "diffbot.toml"
    (folder / "other.toml").write_text(own.read_text() + change)
    view = [sys.executable, "-m", "gateway", "view", *files, "--at", "127.0.0.1:0"]
    with subprocess.Popen(
        view + ["--robot", "other.toml"] * bool(change),
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=os.environ | {"XDG_CACHE_HOME": str(folder), "PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http\S+", process.stdout.readline())
            assert found is not None
            yield found[0]
        finally:
            process.terminate()


def test_two_recordings_are_played_beside_each_other(browser: Chromium, tmp_path: Path) -> None:
    drives = (Goal(1.0, 0.5), 1.0), (Goal(1.0, 0.4), 1.5)
    with beside(tmp_path, *drives, change="\n[brain.pursuit]\nturn_gain = 1.2\n") as url:
        tab = browser.open(url, before=WATCH)
        each = f"{FRAMES}.map(page => page.querySelector('#%s').%s)"
        tab.until(f"{FRAMES}.length === 2")
        tab.until("document.activeElement === document.querySelector('iframe')")  # keys act at once
        for page in (0, 1):
            tab.until(f"{FRAMES}[{page}].querySelector('#answer')?.textContent === 'drive{page + 1}.mcap'")
            tab.until(f"{FRAMES}[{page}].querySelector('#prepared').textContent.startsWith('100 %')")
            tab.until(f"!{FRAMES}[{page}].querySelector('#first').hidden")
        tab.until(f"{each % ('when', 'textContent')}.every(when => when.endsWith('s'))")  # not under way
        opened = tab.run(each % ("seek", "value"))
        assert all(
            0.25 < float(when) <= 1.3 for when in opened
        )  # not before it moves: the goal is at a quarter
        ends = [f"{when[8:-2]} of {when[8:]}" for when in tab.run(each % ("when", "textContent"))]
        click = f"{FRAMES}[0].querySelector('#%s').click()"
        tab.run(click % "play")  # what is pressed in one, both do
        tab.until(f"{each % ('when', 'textContent')}.every((when, i) => when === {ends}[i])")
        tab.until(f"{each % ('play', 'textContent')}.every(text => text === 'Play')")
        tab.run(click % "first")
        first = tab.run(f"{FRAMES}[0].querySelector('#difference').textContent")
        assert re.match(r"0\.\d\d\d s, \w+.*: ", first)
        tab.until(f"{each % ('seek', 'value')}.every(value => Math.abs(value - {first[:5]}) < 0.05)")
        tab.until(f"{each % ('when', 'textContent')}.every(when => when.endsWith('s'))")  # it is there
        begin = tab.run(each % ("seek", "value"))
        tab.run(click % "forth")
        tab.until(f"{each % ('seek', 'value')}.every((value, i) => value > {begin}[i])")
        tab.run(click % "back")
        tab.until(f"{each % ('seek', 'value')}.every((value, i) => value === {begin}[i])")
        close_all(browser)  # before their server is gone: they would look for it


# -- what no robot says ------------------------------------------------------------------------------

HOSTILE = [
    "<img src=x onerror=alert(1)>",
    "</script><script>alert(1)</script>",
    "__proto__",
    "\"'`${1}`",
    "\u202eabc",
    "n" * 5000,
]
EMPTY: dict[str, Any] = {
    "t": 1.0, "state": "ready", "reason": "", "stopped": "", "stop": False, "systems": [], "pose": None,
    "covariance": None, "twist": None, "raw": None, "goal": None, "mission": None, "faults": [],
    "received": [],
}  # fmt: skip


def later(tab: Tab, s: float) -> None:
    """Have the page's clock stand still, so many s later."""
    tab.run(f"(t => {{ performance.now = () => t; }})(performance.now() + {1000 * s})")


class Fake:
    """A server that says what a test wants, and keeps what it is asked. Polled while the test waits."""

    def __init__(self, port: int = 0, access: Access | None = None) -> None:
        self.server = Server(Address(port=port), access or Access(), pages(), {"/cockpit": ("",)})
        self.address, self.now = self.server.address, 0
        self.received: list[Any] = []

    def poll(self) -> None:
        self.now += 1_000_000
        for _, messages in self.server.poll(self.now):
            self.received += filter(None, map(json.loads, messages))
        self.server.flush(self.now)

    def until(self, what: Callable[[], Any], name: str = "what is awaited") -> Any:
        """Return what a function returns once that is true."""

        def polled() -> Any:
            for _ in range(10):
                self.poll()
            return what()

        return wait(polled, name)

    def say(self, kind: str, **content: Any) -> None:
        for client in self.server.clients:
            client.send(json.dumps({"kind": kind} | content))
        self.poll()

    def say_bytes(self, header: Any, data: bytes) -> None:
        head = json.dumps(header).encode()
        head += b" " * (-len(head) % 4)
        for client in self.server.clients:
            client.send(struct.pack("<I", len(head)) + head + data)
        self.poll()

    def close(self) -> None:
        self.server.close()

    def open(self, browser: Chromium, query: str = "", width: int = 1440) -> Tab:
        tab = browser.open(f"http://{self.address}/{query}", width, before=WATCH)
        self.until(lambda: self.server.clients, "a connection")
        return tab

    def show(self, browser: Chromium, about: Any, width: int = 1440) -> Tab:
        """Open a page, and wait until it shows a robot of which a hello tells. Its clock stands still: how
        long the test takes is no silence."""
        tab = self.open(browser, width=width)
        later(tab, 0.0)
        self.say("hello", **about)
        self.say("state", **EMPTY)
        self.until(lambda: tab.run("document.querySelector('#word').dataset.state === 'ready'"))
        tab.drawn()
        return tab


@pytest.fixture
def fake(browser: Chromium) -> Iterator[Fake]:
    with closing(Fake()) as one:
        yield one
        close_all(browser)  # before their server is gone


def hello(
    name: str = "fake", *, mode: str = "live", joints: list[str] | None = None, base: bool = True
) -> Any:
    limits = {"velocity": 1.0, "acceleration": 1.0, "torque": 1.0}
    about = {
        "protocol": name,
        "address": 1,
        "bus": name,
        "commands": ["Velocity"],
        "requests": [],
        "limits": limits,
        "parameters": ["gain"],
    }
    outline = [[0.2, 0.1], [-0.2, 0.1], [-0.2, -0.1], [0.2, -0.1]]
    body = {
        "outline": outline,
        "max_linear": 1.0,
        "max_lateral": 0.5,
        "max_angular": 1.0,
        "turning_radius": 0.0,
    }
    return {
        "robot": name,
        "mode": mode,
        "joints": [{"name": one, "moves": "joint"} | about for one in joints or []],
        "quantities": {name: unit for name, (unit, _) in QUANTITIES.items()},
        "buses": [{"name": name, "kind": "can", "interface": name, "bitrate": 0}],
        "base": body if base else None,
        "steer": mode == "live",
    }


def test_hostile_names_stay_text(browser: Chromium, fake: Fake) -> None:
    tab = fake.open(browser)
    for name in HOSTILE:
        fault = {"joint": name, "name": name, "cause": name, "remedy": name, "code": 1}
        mission = {"name": name, "phase": name, "step": name, "steps": 1, "text": name, "reason": name}
        counters = {"bus": name, "protocol": name, "accepted": 1, "malformed": 1, "ignored": 1}
        fake.say("hello", **hello(name, joints=[name]))
        fake.say(
            "settings",
            rows=[
                {"key": name, "value": 1.0, "file": 2.0},
                {"key": "x" + name, "value": True, "file": False},
            ],
        )
        fake.say("joints", t=1.0, rows=[[name, True, name, None, *[None] * 7, 1]])
        fake.say("note", t=1.0, level=name, source=name, text=name)
        fake.say("note", t=1.0, level="info", source="operator", text=f"set {name}: refused: {name}")
        fake.say("answer", id=None, ok=False, text=name)
        fake.say("unknown", text=name)
        told = {
            "systems": [[name, name, name]],
            "faults": [fault],
            "mission": mission,
            "received": [counters],
        }
        fake.say(
            "state",
            **EMPTY | told | {"reason": name, "recording": name, "trouble": name, "load": {name: 0.5}},
        )
        shown = f"document.querySelector('#faults h3')?.textContent.includes({json.dumps(name)})"
        fake.until(partial(tab.run, f"document.querySelector('#robot').textContent === {json.dumps(name)}"))
        fake.until(partial(tab.run, shown))
        assert tab.run("document.querySelectorAll('body img, body script, body iframe').length") == 0
        assert tab.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


@pytest.mark.parametrize(
    ("state", "colour"),
    [("lost", "bad"), ("doubtful", "warn"), ("too_sure", "warn"), ("waiting", "warn"), ("idle", "text")],
)
def test_what_is_wrong_stands_out(browser: Chromium, fake: Fake, state: str, colour: str) -> None:
    tab = fake.show(browser, hello())
    fake.say("state", **EMPTY | {"systems": [["perception", state, ""]]})
    tab.until("document.querySelector('#systems .chip')")
    chip, page = "getComputedStyle(document.querySelector('#systems .chip'))", "document.documentElement"
    shown = tab.run(f"{chip}.color")
    tab.run(f"{page}.style.color = 'var(--{colour})'")
    assert shown == tab.run(f"getComputedStyle({page}).color")


def test_slow_motion_is_shown_beside_the_mode_and_what_to_do_with_the_loop(
    browser: Chromium, fake: Fake
) -> None:
    tab = fake.show(browser, hello())
    assert not tab.run("document.querySelector('#pace').checkVisibility()")
    fake.say("state", **EMPTY | {"pace": 0.07, "timing": "end other processes"})
    tab.until("document.querySelector('#pace').checkVisibility()")
    assert "slow motion: 0.07" in tab.run("document.querySelector('#pace').textContent")
    assert tab.run("document.querySelector('#timing').textContent") == "end other processes"
    fake.say("state", **EMPTY | {"pace": 1.0, "timing": ""})
    tab.until("!document.querySelector('#pace').checkVisibility()")
    assert tab.run("document.querySelector('#timing').textContent") == "in time"


def test_a_robot_that_may_not_be_steered_any_more_has_no_button_for_its_fault(
    browser: Chromium, fake: Fake
) -> None:
    fault = {"joint": "left", "name": "hot", "cause": "", "remedy": "", "code": 1}
    tab = fake.show(browser, hello())
    fake.say("state", **EMPTY | {"faults": [fault]})
    tab.until("document.querySelector('.fault button')")
    fake.say("hello", **hello() | {"steer": False})  # it was started anew
    fake.say("state", **EMPTY | {"faults": [fault]})
    tab.until("document.querySelector('.fault') && !document.querySelector('.fault button')")


def dots(tab: Tab) -> int:
    """Return how many pixels of the map are of a scan."""
    script = """(canvas => {
      const { width, height } = canvas;
      const pen = new OffscreenCanvas(width, height).getContext("2d");
      pen.drawImage(canvas, 0, 0);
      const pixels = new Uint32Array(pen.getImageData(0, 0, width, height).data.buffer);
      return pixels.filter(one => one === 0xff2a1ad1).length;
    })(document.querySelector("#canvas"))"""
    return int(tab.run(script))


def test_a_scan_is_drawn_until_it_is_old(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    lidar = {"x": 0.0, "y": 0.0, "yaw": 0.0, "min": 0.0, "step": 0.1, "count": 1, "near": 0.1, "far": 9.0}
    header = {"kind": "scan", "lidars": [lidar | {"name": "lidar", "t": 1.0, "poses": [[0.0, 0.0, 0.0]] * 2}]}
    fake.say_bytes(header, struct.pack("<f", 1.0))
    wait(lambda: dots(tab) > 0, "a dot")
    fake.say("state", **EMPTY | {"t": 2.9})
    fake.say_bytes(header, struct.pack("<f", 1.0))  # the newest is sent over and over
    tab.until("seen.in.filter(([, one]) => one.kind === 'scan').length === 2")
    tab.drawn()
    assert dots(tab) > 0
    fake.say("state", **EMPTY | {"t": 3.1})
    wait(lambda: dots(tab) == 0, "no dot")


def test_the_map_is_sharp_on_whatever_screen_the_window_is_moved_to(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    size = {"width": 1440, "height": 900, "mobile": False}
    tab.call("Emulation.setDeviceMetricsOverride", deviceScaleFactor=2, **size)
    fake.say("state", **EMPTY)
    tab.until("(c => c.width === 2 * c.clientWidth)(document.querySelector('#canvas'))")


def test_a_lost_connection_is_shown_and_nothing_is_sent_by_itself_after_it(
    browser: Chromium, fake: Fake
) -> None:
    tab = fake.show(browser, hello())
    tab.key("keyDown", "KeyW", "w")
    fake.until(
        lambda: len([one for one in fake.received if one == {"held": "drive 0.500 0.000 0.000"}]) > 2,
        "driving",
    )
    fake.close()
    tab.until("document.querySelector('#banner').hidden === false")
    assert "the gateway ends" in tab.text("#banner")
    assert tab.run("document.querySelector('#main').inert && document.querySelector('#stop').disabled")
    with closing(Fake(fake.address.port)) as again:
        later(tab, 2.0)
        again.until(lambda: again.server.clients, "a new connection")
        again.say("hello", **hello())
        again.say("state", **EMPTY)
        again.until(lambda: tab.run("document.querySelector('#banner').hidden"))
        tab.key("keyUp", "KeyW", "w")
        assert again.received == []
        assert all("WebSocket connection" in one for one in tab.problems)
        tab.close()


def test_while_nothing_comes_from_the_robot_only_a_stop_is_sent(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    tab.key("keyDown", "KeyW", "w")
    fake.until(lambda: fake.received)
    later(tab, 2.0)
    fake.until(lambda: tab.text("#banner") == "No data from the robot. What is shown is old.")
    fake.until(lambda: fake.received[-1] == {"held": ""})
    fake.received.clear()
    tab.key("keyUp", "KeyW", "w")
    tab.key("keyDown", "KeyA", "a")
    tab.key("keyUp", "KeyA", "a")
    tab.type("#line", "goal 1 1")
    tab.until("document.querySelector('#log .refused')?.textContent.includes('not sent')")
    tab.click("#record")
    tab.click("#stop")  # which is tried all the same
    fake.until(lambda: any("ask" in one for one in fake.received), "a stop")
    asked = [one for one in fake.received if one != {"held": ""}]
    assert [one["ask"] for one in asked] == ["stop an operator pressed STOP"]


def test_a_connection_over_which_nothing_comes_is_made_anew(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    (first,) = fake.server.clients
    later(tab, 6.0)
    fake.until(lambda: first not in fake.server.clients, "the end of the old connection")
    assert tab.text("#banner").startswith("Not connected. The robot receives nothing from this page.")
    assert tab.run("document.querySelector('#stop').disabled")
    later(tab, 2.0)
    fake.until(lambda: fake.server.clients, "a new connection")
    fake.say("hello", **hello())
    fake.say("state", **EMPTY)
    fake.until(lambda: tab.run("document.querySelector('#banner').hidden"))


def test_a_page_without_its_token_says_what_to_open(browser: Chromium) -> None:
    refused = []

    class Noted(Access):
        def refused(self, path: str, host: str, origin: str | None) -> tuple[int, str]:
            refused.append(path)
            return super().refused(path, host, origin)

    with closing(Fake(access=Noted(token="a token of 20 characters"))) as fake:
        tab = browser.open(f"http://{fake.address}/")
        fake.until(lambda: refused, "a connection without it")
        tab.until("document.querySelector('#banner').textContent.includes('its token')")
        tab.close()


def test_the_controls_of_a_replay_ask_for_what_they_say(browser: Chromium, fake: Fake) -> None:
    tab = fake.open(browser)
    difference = {"t": 1.5, "kind": "packets", "text": "the first that differs"}
    playback = {
        "playing": False,
        "rate": 1.0,
        "t": 1.0,
        "due": 1.0,
        "length": 6.0,
        "prepared": 0.25,
        "differences": [difference],
    }
    fake.say("hello", **hello(mode="replay"))
    fake.say("state", **EMPTY | {"playback": playback, "recordings": 2})
    fake.until(lambda: tab.run("document.querySelector('#when').textContent") == "1.00 of 6.00 s")
    assert not tab.run("document.querySelector('#replay').hidden")
    assert "25 %" in tab.text("#prepared")
    assert tab.run("document.querySelector('#stopping').hidden && document.querySelector('#drive').hidden")
    tab.click("#play")
    tab.click("#forth")
    tab.click("#back")
    tab.run("document.querySelector('#rate').value = '2'")
    tab.run("document.querySelector('#rate').dispatchEvent(new Event('change'))")
    tab.click("#seek")
    tab.click("#marks button")
    tab.click("#first")
    tab.run("document.activeElement.blur()")
    tab.key("keyDown", "Space", " ")
    fake.until(lambda: len(fake.received) == 8)
    seek = fake.received.pop(4)["play"]["seek"]
    assert seek == pytest.approx(3.0, abs=0.1)
    asked: list[Any] = [
        {"playing": True},
        {"step": 1},
        {"step": -1},
        {"rate": 2},
        {"seek": 1.5},
        {"seek": 1.5},
        {"playing": True},
    ]
    assert fake.received == [{"play": one} for one in asked]
    assert tab.text("#difference") == "1.500 s, packets: the first that differs"


def test_the_slider_of_a_replay_stays_where_it_was_put(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello(mode="replay"))
    playback: Any = {"playing": False, "rate": 1.0, "length": 60.0, "prepared": 1.0, "differences": []}

    def say(t: float, due: float) -> None:
        at = {"t": t, "due": due, "under_way": t != due}
        fake.say("state", **EMPTY | {"playback": playback | at, "recordings": 1})
        tab.until(f"document.querySelector('#when').textContent.startsWith('{t:.2f}')")

    say(1.0, 1.0)
    tab.run("document.querySelector('#seek').focus()")
    for code in ("ArrowRight", "ArrowRight", "ArrowLeft", "ArrowRight"):
        tab.key("keyDown", code)
        say(1.01, 1.01)  # which the gateway said before it heard of it
    assert [one["seek"] for one in sent(tab, "play")] == [2.0, 3.0, 2.0, 3.0]
    slider = "document.querySelector('#seek')"
    for t in (1.02, 1.5, 1.8, 2.4):  # it is on its way
        say(t, 3.0)
        assert tab.run(f"{slider}.value") == "3"
    say(3.1, 3.1)
    assert tab.run(f"[{slider}.value, {slider}.getAttribute('aria-valuetext')]") == ["3.1", "3.10 of 60.00 s"]


def test_a_page_says_that_it_is_still_there(browser: Chromium, fake: Fake) -> None:
    tab = fake.show(browser, hello())
    before = tab.run("seen.alive")
    for _ in range(2):
        later(tab, 2.1)
        fake.say("state", **EMPTY)
        tab.until(f"seen.alive > {before}")
        before += 1
    assert fake.received == []


def test_the_token_of_the_address_is_brought_along(browser: Chromium) -> None:
    with closing(Fake(access=Access(token="a token + of 20 characters"))) as fake:
        tab = fake.open(browser, "?token=a%20token%20%2B%20of%2020%20characters")
        fake.say("hello", **hello())
        fake.until(lambda: tab.text("#robot") == "fake")
        close_all(browser)


# -- without a browser -------------------------------------------------------------------------------

TEXT_ON = [
    ("text", "back"), ("text", "panel"), ("dim", "panel"), ("dim", "back"), ("accent", "panel"),
    ("good", "panel"), ("good", "good-back"), ("warn", "panel"), ("warn", "warn-back"), ("bad", "panel"),
    ("bad", "bad-back"), ("panel", "accent"), ("panel", "bad"), ("panel", "dim"),
]  # fmt: skip


def contrast(*colours: str) -> float:
    """Return the contrast of two colours: WCAG 2.1."""
    dark, light = sorted(map(luminance, colours))
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb: WCAG 2.1."""
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    r, g, b = (c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def test_colours_have_the_contrast_that_they_need() -> None:
    blocks = re.findall(r":root \{(.*?)\}", (PAGE / "cockpit.css").read_text(), re.S)
    light, dark = (dict(re.findall(r"--([\w-]+): (#\w{6});", block)) for block in blocks)
    for colours in (light, dark):
        for text, back in [*TEXT_ON, ("#ffffff", "stop")]:
            assert contrast(colours.get(text, text), colours[back]) >= 4.5, (text, back)  # WCAG 2.1, 1.4.3
        for what in ("wall", "robot", "path", "trail", "raw", "scan", "goal"):
            for back in ("free", "unknown"):
                on_map = colours[f"map-{what}"], colours[f"map-{back}"]
                assert contrast(*on_map) >= 3.0, (what, back)  # 1.4.11: graphics
        for number in range(8):
            assert contrast(colours[f"plot-{number}"], colours["panel"]) >= 3.0, number


def test_the_page_is_light_and_needs_no_other_server() -> None:
    files = [one for one in PAGE.iterdir() if one.suffix != ".LICENSE"]
    assert sum(one.stat().st_size for one in files) < 175_000
    assert sum(len(one.packed) for path, one in pages().items() if path != "/") < 66_000  # by gzip, as sent
    for one in files:
        if one.name != "uplot.js":
            addresses = re.findall(r"https?://[^\s\"']+", one.read_text())
            assert set(addresses) <= {"http://www.w3.org/2000/svg"}, one.name
            assert not re.search(
                r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(", one.read_text()
            ), one.name
