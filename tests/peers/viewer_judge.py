"""Shows the values of `ua-space live` in the viewer Foxglove Studio, in Chromium: messages of a ROS
type, a value in JSON, and transforms in 3D. The screenshots are in the folder of --out."""

import argparse
import base64
import pathlib
import re
import time

from selenium import webdriver

SOON = 90


class Viewer:
    def __init__(self, page, source, out):
        options = webdriver.ChromeOptions()
        # The 3D view needs WebGL, which runs without a graphics card here.
        for argument in ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
                         "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]:
            options.add_argument(argument)
        options.binary_location = "/usr/bin/chromium"
        service = webdriver.ChromeService("/usr/bin/chromedriver")
        self.driver = webdriver.Chrome(options=options, service=service)
        self.driver.set_window_size(1280, 800)
        self.page, self.source, self.out = page, source, out

    def shows(self, topic, wanted):
        """Opens the messages of a topic, and waits until the viewer shows all wanted patterns."""
        self.driver.get(f"{self.page}?ds=foxglove-websocket&ds.url={self.source}&topic={topic}")
        end = time.monotonic() + SOON
        text, missing = "", wanted
        while time.monotonic() < end and missing:
            time.sleep(0.5)
            text = self.driver.execute_script("return document.body.innerText")
            missing = [pattern for pattern in wanted if not re.search(pattern, text)]
        name = topic.strip("/").replace("/", "-")
        (self.out / f"{name}.png").write_bytes(base64.b64decode(self.driver.get_screenshot_as_base64()))
        if missing:
            raise SystemExit(f"{topic}: not within {SOON} s: {missing}; the viewer shows:\n{text}")
        print(f"{topic}: the viewer shows {', '.join(wanted)}")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--page", required=True, help="the address of the viewer")
    parser.add_argument("--source", required=True, help="the address of ua-space live")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    viewer = Viewer(args.page, args.source, args.out)
    try:
        # The 3D view subscribes to transforms by itself: they have a rate.
        transforms = r"/tool\s+geometry_msgs/msg/TransformStamped\s+\d+\s+[\d.]+ Hz"
        viewer.shows("/tool", [transforms, "TransformStamped @", r"child_frame_id\s+\"tool\"", "x\\s+1.5"])
        viewer.shows("/Line/Speed-1", [transforms, "ua_0_3_11 @", r"\b1\.25\b"])
    finally:
        viewer.driver.quit()


main()
