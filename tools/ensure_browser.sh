#!/usr/bin/env bash
# Makes sure that there is a Chromium with its driver, in which the tests drive the pages of lerobot-wmrl-play, and npm,
# which fetches what runs networks in a browser.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/packages.sh

browser_runs() {
    command -v chromedriver >/dev/null && { command -v chromium || command -v google-chrome; } >/dev/null
}

if ! browser_runs; then
    as_root "Chromium, for the tests of lerobot-wmrl-play" \
        sh -c "apt-get update && apt-get install -y --no-install-recommends chromium chromium-driver"
fi

if ! command -v npm >/dev/null; then
    as_root "npm, for the tests of lerobot-wmrl-play" \
        sh -c "apt-get update && apt-get install -y --no-install-recommends npm"
fi
