"""The page in Chromium, and what a person does with it."""

import time
from collections.abc import Callable
from typing import Any

from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webdriver import WebDriver

SECONDS = 60


class Page:
    """The page in a window of its own, and what a person would do with it."""

    def __init__(self, driver: WebDriver, url: str) -> None:
        self.driver = driver
        driver.switch_to.new_window("window")
        driver.get(url)
        self.wait(lambda: self["status"].text == "ready")

    def __getitem__(self, name: str) -> Any:
        return self.driver.find_element(By.ID, name)

    def wait(self, condition: Callable[[], Any]) -> None:
        """Wait until something is the case."""
        last = time.monotonic() + SECONDS
        while not condition():
            assert time.monotonic() < last, self["status"].text
            time.sleep(0.02)

    def state(self, expression: str) -> Any:
        """Evaluate JavaScript on what the page shows."""
        return self.driver.execute_script(f"return {expression}")

    @property
    def frame(self) -> int:
        return int(self["counter"].text.split()[1])

    @property
    def image(self) -> str:
        return self.driver.find_element(By.CSS_SELECTOR, "#strip-imagined img").get_attribute("src")

    def press(self, *keys: str) -> None:
        """Press keys one after the other."""
        for key in keys:
            ActionChains(self.driver).send_keys(key).perform()

    def hold(self, key: str, until: int) -> None:
        """Hold a key down until a frame is reached, then pause."""
        ActionChains(self.driver).key_down(key).perform()
        self.wait(lambda: self.frame >= until)
        ActionChains(self.driver).key_up(key).perform()
        self.pause()

    def pause(self) -> None:
        """Stop, and wait until the last answer is there."""
        if "pause" in self["play"].text:
            self["play"].click()
        frame = -1
        while frame != self.frame:
            frame = self.frame
            time.sleep(0.3)

    def choose(self, driver: str) -> None:
        """Let somebody act."""
        self.driver.find_element(By.CSS_SELECTOR, f"#drivers button[value={driver}]").click()
