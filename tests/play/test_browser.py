"""The page in Chromium: driving by keys, pad and policy, going back, saving, losing the connection."""

from collections.abc import Iterator

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from tests.play.page import Page
from tests.trained import run_training, tokenizer_config


@pytest.fixture
def served(world, saved, serve):
    return serve(world, saved)


@pytest.fixture
def page(served, chromium) -> Iterator[Page]:
    chromium.get_log("browser")
    yield Page(chromium, served.address)
    assert [entry for entry in chromium.get_log("browser") if entry["source"] == "javascript"] == []


def test_a_drive_by_keys_a_policy_and_back_a_branch_and_a_dataset_to_learn_from(page, folder, tmp_path):
    page.hold(Keys.ARROW_RIGHT, 100)
    driven = page.frame
    assert page.frame >= 100

    page.press("2", " ")
    page.wait(lambda: page.frame >= driven + 10)
    page.hold(Keys.ARROW_UP, page.frame + 5)  # a driving key takes over
    assert page.state("document.querySelector('#drivers [aria-pressed=true]').value") == "you"

    timeline = page["timeline"]
    page.driver.execute_script(
        "arguments[0].value = 40; arguments[0].dispatchEvent(new Event('input'))", timeline
    )
    assert page.frame == 40
    before = page.image
    page.choose("policy")
    page["next"].click()
    page.wait(lambda: page.frame == 41)
    page["back"].click()
    assert page.image == before

    page["next"].click()  # goes back to frame 40 and branches off again
    page.wait(lambda: page.frame == 41)
    page.press("s")
    page.wait(lambda: "episode 0 (success)" in page["saved"].text)
    page.press("f")
    page.wait(lambda: "episode 1 (failure)" in page["saved"].text)
    table = read_episodes(open_dataset(folder))
    assert table.length.tolist() == [41, 41]
    assert table.success.tolist() == [True, False]
    assert (table.action[:40, 0] > 0).any()
    run_training(tokenizer_config(), folder, tmp_path / "tokenizer")


def test_a_reloaded_page_and_a_server_that_comes_back_find_the_drive(page, served):
    page.hold("e", 8)
    frame, image = page.frame, page.image
    page.driver.refresh()
    page.wait(lambda: page["status"].text == "ready")
    assert (page.frame, page.image) == (frame, image)

    port = served.http.port
    served.stop()
    page.wait(lambda: "no connection" in page["status"].text)
    served.start(port)
    page.wait(lambda: page["status"].text == "ready" and page.frame == frame)
    assert page.image == image


def test_a_link_replays_what_was_driven(page, chromium):
    page.hold(Keys.ARROW_UP, 6)
    frame, image = page.frame, page.image
    page["link"].click()
    page.wait(lambda: "#" in page.driver.current_url)
    other = Page(chromium, page.driver.current_url)
    assert (other.frame, other.image) == (frame, image)


def test_two_visitors_drive_at_once(page, served, chromium):
    page.hold(Keys.ARROW_UP, 5)
    first, frame = chromium.current_window_handle, page.frame
    other = Page(chromium, served.address)
    other.hold(Keys.ARROW_DOWN, 3)
    assert other.frame != 0
    chromium.switch_to.window(first)
    assert page.frame == frame
    page["next"].click()
    page.wait(lambda: page.frame == frame + 1)


def test_the_pad_moves_the_axes_that_are_chosen_for_it(page):
    drag = ActionChains(page.driver).move_to_element(page["pad"]).click_and_hold()
    drag.move_by_offset(20, 40).perform()
    page.wait(lambda: page.frame >= 3)
    x, y = (
        float(page.state(f"document.querySelectorAll('#axes input[type=range]')[{i}].value")) for i in (0, 1)
    )
    assert x > 0 > y
    ActionChains(page.driver).release().perform()
    page.pause()


def test_held_axes_go_on_from_where_somebody_else_has_left_them(page):
    """The gripper, of which the recorded episode has closed what was open."""
    slider = "document.querySelectorAll('#axes input[type=range]')[6]"
    page.hold("h", 12)
    mine = float(page.state(f"{slider}.value"))
    page["restart"].click()
    page.wait(lambda: page.frame == 0)
    page.driver.execute_script(f"{slider}.value = 1; {slider}.dispatchEvent(new Event('input'))")
    page.choose("recorded")
    page["next"].click()
    page.wait(lambda: page.frame == 1)
    recorded = float(page.state(f"{slider}.value"))
    page.choose("you")
    page["next"].click()
    page.wait(lambda: page.frame == 2)
    assert float(page.state(f"{slider}.value")) == recorded != 1
    assert mine > recorded


def test_keys_can_be_chosen(page):
    page.driver.find_element(By.CSS_SELECTOR, '#axes kbd[data-key="2,1"]').click()
    page.press("x")
    ActionChains(page.driver).key_down("x").perform()
    page.wait(lambda: float(page.state("document.querySelectorAll('#axes input[type=range]')[2].value")) > 0)
    ActionChains(page.driver).key_up("x").perform()
    page.pause()


def test_an_episode_that_is_not_there_is_refused_and_the_drive_stays(page):
    page["episode"].clear()
    page["episode"].send_keys("5")
    page["episode-frame"].clear()
    page["episode-frame"].send_keys("3")
    page.driver.execute_script(
        "document.querySelectorAll('form').forEach((form) => { form.noValidate = true; })"
    )
    page.driver.find_element(By.CSS_SELECTOR, "#place-episode button").click()
    page.wait(lambda: page.state("document.getElementById('status').textContent") == "ready")
    page["episode"].clear()
    page["episode"].send_keys("6")
    page.driver.find_element(By.CSS_SELECTOR, "#place-episode button").click()
    page.wait(lambda: "must be a whole number from 0 to 5" in page["status"].text)
    page["next"].click()
    page.wait(lambda: page.frame == 1)


def test_the_page_fits_a_phone(page):
    size = page.driver.get_window_size()
    page.driver.set_window_size(500, 900)  # the least that a window of Chromium can be
    try:
        assert page.state("document.documentElement.scrollWidth <= innerWidth")
        page.hold(Keys.ARROW_UP, 3)
    finally:
        page.driver.set_window_size(size["width"], size["height"])


def test_maniskill_takes_the_same_actions_beside(make_world, saved, serve, chromium):
    page = Page(chromium, serve(make_world(real=True), saved).address)
    page.driver.find_element(By.CSS_SELECTOR, "#places button[value=seed]").click()
    page.driver.find_element(By.CSS_SELECTOR, "#place-seed button").click()
    page.wait(lambda: page["status"].text == "ready" and page["strip-beside"].is_displayed())
    real = "document.querySelector('#strip-beside img').src"
    assert "wmrl_maniskill: third_view" in page["strip-beside"].text
    first = page.state(real)
    page.hold(Keys.ARROW_UP, 8)
    moved, frame = page.state(real), page.frame
    assert moved != first
    assert not page["strip-difference"].is_displayed()
    page["difference"].click()
    assert page["strip-difference"].is_displayed()
    page["restart"].click()
    page.wait(lambda: page.frame == 0)
    assert page.state(real) == first
    assert frame >= 8
