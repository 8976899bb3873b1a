"""Drives the page of the cell in Chromium: every view of a running demo, in both colours and at the
width of a phone, by the rules of axe-core and of HTML, and the commands and alarms of a signed-in operator. Any console
message fails."""

import argparse
import base64
import json
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time

from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

WIDE = (1280, 800)
PHONE = (390, 844)
PASSWORD = "correct horse battery"
SOON = 60
# A module with a picture.
MANIFEST = pathlib.Path(__file__).resolve().parent.parent / "data" / "mtp" / "column.aml"


class Judge:
    def __init__(self, out, axe):
        self.axe = axe.read_text()
        options = webdriver.ChromeOptions()
        for argument in ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]:
            options.add_argument(argument)
        options.binary_location = "/usr/bin/chromium"
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        service = webdriver.ChromeService("/usr/bin/chromedriver")
        self.driver = webdriver.Chrome(options=options, service=service)
        self.driver.set_page_load_timeout(SOON)
        self.out = out
        self.faults = []

    def look(self, scheme, size):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def open(self, url, view):
        self.driver.get(f"{url}#/{view}")
        self.driver.refresh()

    def wait(self, what, condition):
        try:
            # The page replaces elements between a look and the next one.
            wait = WebDriverWait(self.driver, SOON, 0.2, ignored_exceptions=[StaleElementReferenceException])
            return wait.until(lambda _: condition())
        except Exception:
            self.shoot("fault")
            text = self.driver.find_element(By.TAG_NAME, "body").text
            raise SystemExit(f"not within {SOON} s: {what}; the page shows:\n{text}") from None

    def text(self, selector="main"):
        found = self.driver.find_elements(By.CSS_SELECTOR, selector)
        return found[0].text if found else ""

    def shoot(self, name):
        shot = self.driver.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})
        (self.out / f"{name}.png").write_bytes(base64.b64decode(shot["data"]))

    def overflow(self, name):
        wide = self.driver.execute_script(
            "return document.documentElement.scrollWidth - document.documentElement.clientWidth")
        if wide > 0:
            self.faults.append(f"{name}: the page is {wide} px wider than the window")

    def accessible(self, name):
        """Applies the rules of axe-core, and keeps the document for the validator."""
        html = self.driver.execute_script("return document.documentElement.outerHTML")
        folder = self.out / "html"
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.html").write_text(f"<!DOCTYPE html>\n{html}\n")
        self.driver.execute_script(self.axe)
        broken = self.driver.execute_async_script(
            "const done = arguments[arguments.length - 1];"
            "axe.run(document).then((result) => done(result.violations.map((rule) =>"
            " [rule.id, rule.impact, rule.nodes[0].html.slice(0, 160)])))")
        self.faults.extend(f"{name}: {rule}" for rule in broken)

    def console(self):
        for entry in self.driver.get_log("browser"):
            self.faults.append(f"console: {entry['level']} {entry['message']}")


    def valid(self, validator, out):
        """Applies the rules of the HTML standard to all documents that were kept."""
        config = out / "rules.json"
        config.write_text(json.dumps({"root": True, "extends": ["html-validate:standard"]}))
        documents = sorted(out.glob("**/html/*.html"))
        ended = subprocess.run([validator, "--config", config, "--formatter", "json", *documents], capture_output=True, text=True)
        if not documents or ended.returncode not in (0, 1):
            raise SystemExit(f"the validator read {len(documents)} documents:\n{ended.stderr}")
        broken = {}
        for document in json.loads(ended.stdout or "[]"):
            for one in document["messages"]:
                broken.setdefault((one["ruleId"], one["message"]), []).append(pathlib.Path(document["filePath"]).stem)
        self.faults.extend(f"HTML: {rule}: {message} in {', '.join(sorted(set(of))[:4])}" for (rule, message), of in broken.items())
        return len(documents)


def page_of(demo):
    """Returns the address of the page and the folder of the logs, which the demo prints."""
    for line in demo.stdout:
        print(line, end="")
        found = re.search(r"page of the cell (?:is )?at (http://\S+/), the logs (?:are )?in (\S+)\.", line)
        if found:
            return found.groups()
    raise SystemExit("the demo has not printed the address of its page")


def views(judge, url, topic):
    """Takes every view in both colours and widths."""
    for scheme in ["light", "dark"]:
        for size in [WIDE, PHONE]:
            judge.look(scheme, size)
            for view in ["programs", "values", f"topic/{topic}", "map", "skills", "processes", "knowledge", "events", "alarms"]:
                judge.open(url, view)
                judge.wait(f"{view} is live", lambda: judge.text("#link") == "live")
                judge.wait(f"{view} has a title", lambda: judge.text("h1"))
                # The first events have arrived when a rate can be shown.
                time.sleep(1.5)
                name = f"{view.split('/')[0]}-{scheme}-{'phone' if size == PHONE else 'wide'}"
                judge.shoot(name)
                judge.overflow(name)
                judge.accessible(name)


def values(judge, url):
    """Waits for values that move, and returns the topic of one."""
    judge.look("light", WIDE)
    judge.open(url, "values")
    readings = lambda: [one.text for one in judge.driver.find_elements(By.CSS_SELECTOR, "td .reading")]
    judge.wait("there are values", lambda: any(text not in ("", "–") for text in readings()))
    first = readings()
    judge.wait("values move", lambda: readings() != first)
    search = judge.driver.find_element(By.CSS_SELECTOR, "input[type=search]")
    search.send_keys("no such topic")
    judge.wait("a filter without a match says so", lambda: "No values" in judge.text())
    search.send_keys(Keys.CONTROL, "a")
    search.send_keys(Keys.DELETE)
    link = judge.wait("the list is back", lambda: judge.driver.find_elements(By.CSS_SELECTOR, "th.name a"))[0]
    # The keyboard reaches a topic.
    link.send_keys(Keys.ENTER)
    judge.wait("the topic is shown", lambda: "Last samples" in judge.text())
    topic = judge.driver.current_url.rsplit("/", 1)[-1]
    judge.driver.back()
    return topic


def events(judge, url):
    """Waits for strips and rows, holds the view by the keyboard, and changes the period."""
    judge.look("light", WIDE)
    judge.open(url, "events")
    # The page replaces its rows meanwhile, so all are read at once.
    rows = lambda: judge.driver.execute_script(
        "return [...document.querySelectorAll('tbody tr[data-id]')].map((row) => row.dataset.id)")
    judge.wait("there are events", rows)
    judge.wait("there is a strip", lambda: judge.driver.find_elements(By.CSS_SELECTOR, ".gantt .event-bar"))
    first = rows()[0]
    judge.wait("events are added", lambda: rows()[0] != first)
    hold = judge.driver.find_element(By.CSS_SELECTOR, "main input[type=checkbox]")
    hold.send_keys(Keys.SPACE)
    if not hold.is_selected():
        judge.faults.append("events: the keyboard does not hold the view")
    hold.send_keys(Keys.SPACE)
    judge.driver.find_element(By.CSS_SELECTOR, "main select").send_keys("All")
    judge.wait("all events are drawn", lambda: judge.driver.find_elements(By.CSS_SELECTOR, ".gantt .event-bar"))


def recorded(judge, binaries, file):
    """Shows a recording of the demo on a page of its own."""
    address = "127.0.0.1:9153"
    page = subprocess.Popen([binaries / "ua-space", "page", "--interface", "lo", "--metrics", address, "--recording", file],
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        url = f"http://{address}/"
        judge.wait("the page is served", lambda: served(judge, url))
        for scheme in ["light", "dark"]:
            for size in [WIDE, PHONE]:
                judge.look(scheme, size)
                judge.open(url, "events")
                judge.wait("the recording is named", lambda: file.name in judge.text(".summary"))
                judge.wait("there is a strip", lambda: judge.driver.find_elements(By.CSS_SELECTOR, ".gantt .event-bar"))
                judge.driver.find_element(By.CSS_SELECTOR, "main select").send_keys("All")
                name = f"recording-{scheme}-{'phone' if size == PHONE else 'wide'}"
                judge.shoot(name)
                judge.overflow(name)
                judge.accessible(name)
        judge.console()
        judge.driver.get("about:blank")
    finally:
        page.send_signal(signal.SIGTERM)
        page.wait(20)


def add_user(binaries, pki, name, role):
    add = [binaries / "ua-server", "user", "add", name, "--role", role, "--pki", pki]
    subprocess.run(add, input=PASSWORD, text=True, check=True, stdout=subprocess.DEVNULL)


def sign(judge, name):
    """Signs in by the dialog."""
    judge.wait("nobody is signed in", lambda: judge.text("#sign") == "Sign in")
    judge.driver.find_element(By.ID, "sign").click()
    for field, text in [("user", name), ("password", PASSWORD)]:
        box = judge.driver.find_element(By.NAME, field)
        box.clear()
        box.send_keys(text)
    judge.driver.find_element(By.CSS_SELECTOR, "dialog[open] [type=submit]").click()
    judge.wait(f"{name} is signed in", lambda: name in judge.text("#user"))


def switch_off(judge, binaries, url, folder):
    """Switches the conveyor off, and waits until the robot that replaces it moves."""
    add_user(binaries, pathlib.Path(folder) / "server-pki", "anna", "operator")
    judge.look("light", WIDE)

    def may_sign_in():
        judge.open(url, "skills")
        return judge.text("#sign") == "Sign in"

    judge.wait("the server knows its user", may_sign_in)
    sign(judge, "anna")
    call = judge.wait("the call is there", lambda: judge.driver.find_elements(By.CSS_SELECTOR, "[aria-label*='Conveyor']"))
    call[0].click()
    judge.shoot("call-light-wide")
    judge.driver.find_element(By.CSS_SELECTOR, "dialog[open] [type=submit]").click()
    judge.wait("the call was answered", lambda: not judge.driver.find_elements(By.CSS_SELECTOR, "dialog[open] [type=submit]"))
    judge.open(url, "values")
    row = lambda name: next((one.text for one in judge.driver.find_elements(By.CSS_SELECTOR, "tbody tr") if name in one.text), "")
    judge.wait("the conveyor stands", lambda: "false" in row("/conveyor/running"))
    judge.wait("the TurtleBot3 takes over", lambda: "true" in row("/park/busy") + row("/bucket/busy"))
    judge.shoot("switched-off-light-wide")


def operate(judge, binaries, folder, examples):
    """Signs in, and starts a skill by its form."""
    pki = folder / "pki"
    for name, role in [("anna", "operator"), ("otto", "observer")]:
        add_user(binaries, pki, name, role)
    address = "127.0.0.1:9151"
    commands = [
        [binaries / "ua-server", "--pki", pki, "--interface", "lo", "--metrics", address, "--endpoint", "opc.tcp://127.0.0.1:48401"],
        [binaries / "ua-component", examples / "parallel-gripper.yaml", "--interface", "lo", "--lds", "none", "--pki", folder / "component"],
    ]
    log = (folder / "operate.log").open("w")
    running = [subprocess.Popen(command, stdout=log, stderr=log) for command in commands]
    try:
        url = f"http://{address}/"
        judge.wait("the page is served", lambda: served(judge, url))
        judge.look("dark", WIDE)
        judge.open(url, "skills")
        judge.wait("the skill is there", lambda: "Grasp" in judge.text())
        buttons = lambda: [one.text for one in judge.driver.find_elements(By.CSS_SELECTOR, ".tile .button")]
        if buttons():
            judge.faults.append("a stranger has buttons")
        sign(judge, "otto")
        if buttons():
            judge.faults.append("an observer has buttons")
        judge.driver.find_element(By.ID, "sign").click()
        sign(judge, "anna")
        judge.wait("the operator has buttons", buttons)
        if "Reset" in buttons():
            judge.driver.find_element(By.CSS_SELECTOR, "[aria-label='Reset parallel-gripper.Grasp']").click()
        start = "[aria-label='Start parallel-gripper.Grasp']"
        judge.wait("the skill is ready", lambda: judge.driver.find_elements(By.CSS_SELECTOR, start))[0].click()
        judge.driver.find_element(By.NAME, "Force").send_keys("12.5")
        judge.shoot("form-dark-wide")
        judge.driver.find_element(By.CSS_SELECTOR, "dialog[open] [type=submit]").click()
        judge.wait("the run has succeeded", lambda: "Succeeded" in judge.text())
        judge.shoot("operator-dark-wide")
        judge.console()
        judge.driver.get("about:blank")
    finally:
        for process in running:
            process.send_signal(signal.SIGTERM)
        for process in running:
            process.wait(20)
        log.close()


def alarms(judge, binaries, folder):
    """Acknowledges and confirms an alarm by the dialogs, in both colours and widths."""
    pki = folder / "alarms-pki"
    for name, role in [("anna", "operator"), ("otto", "observer")]:
        add_user(binaries, pki, name, role)
    mapping = folder / "alarms.yaml"
    mapping.write_text("""
namespaces: {2: urn:page-judge}
variables:
  - {node: ns=2;i=30, name: Line.Temperature, type: Double, origin: 0, alarm: {high: 70, high_high: 90, confirm: true}}
  - {node: ns=2;i=31, name: Line.Guard, type: Boolean, origin: 0, alarm: {normal: true, severity: 900}}
  - {node: ns=2;i=32, name: Line.Mode, type: Int32, origin: 0, enum: {0: idle, 3: fault}, alarm: {when: [fault]}}
""")
    address = "127.0.0.1:9152"
    command = [binaries / "ua-server", mapping, "--pki", pki, "--interface", "lo", "--metrics", address, "--endpoint", "opc.tcp://127.0.0.1:48402"]
    log = (folder / "alarms.log").open("w")
    server = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        url = f"http://{address}/"
        judge.wait("the page is served", lambda: served(judge, url))
        judge.look("light", WIDE)
        judge.open(url, "alarms")
        judge.wait("the conditions are listed", lambda: "Temperature" in judge.text())
        sign(judge, "anna")
        judge.open(url, "topic/ua_0_2_30")
        box = judge.wait("the value can be written", lambda: judge.driver.find_elements(By.CSS_SELECTOR, "main form input"))[0]
        box.send_keys("95", Keys.ENTER)
        judge.wait("the value is written", lambda: "95" in judge.text("main .fields") or "95" in judge.text())
        judge.open(url, "alarms")
        first = lambda: judge.text(".alarm")
        judge.wait("the alarm is first", lambda: "HighHigh" in first() and "unacknowledged" in first())
        for scheme in ["light", "dark"]:
            for size in [WIDE, PHONE]:
                judge.look(scheme, size)
                name = f"alarm-{scheme}-{'phone' if size == PHONE else 'wide'}"
                judge.shoot(name)
                judge.overflow(name)
                judge.accessible(name)
        judge.look("light", WIDE)
        for action, after in [("Acknowledge", "unconfirmed"), ("Confirm", "anna: seen")]:
            button = f"[aria-label='{action} Line.Temperature']"
            judge.wait(f"{action} is offered", lambda: judge.driver.find_elements(By.CSS_SELECTOR, button))[0].click()
            judge.driver.find_element(By.NAME, "comment").send_keys("seen")
            judge.shoot(f"{action.lower()}-light-wide")
            judge.accessible(action)
            judge.driver.find_element(By.CSS_SELECTOR, "dialog[open] [type=submit]").click()
            judge.wait(f"{action} is done", lambda: after in first() and not judge.driver.find_elements(By.CSS_SELECTOR, button))
        judge.driver.find_element(By.ID, "sign").click()
        sign(judge, "otto")
        if judge.driver.find_elements(By.CSS_SELECTOR, ".alarm .button"):
            judge.faults.append("an observer has buttons of alarms")
        judge.console()
        judge.driver.get("about:blank")
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(20)
        log.close()


def knowledge(judge, binaries, folder):
    """Queries a MES, and loads a file as an engineer, in both colours and widths."""
    pki = folder / "knowledge-pki"
    for name, role in [("erna", "engineer"), ("otto", "operator")]:
        add_user(binaries, pki, name, role)
    mes = folder / "mes.yaml"
    mes.write_text("mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n"
                   "endpoint: opc.tcp://127.0.0.1:48404\nsecurity: [None]\n")
    good, bad = folder / "arm.ttl", folder / "bad.ttl"
    good.write_text("@prefix css: <http://www.w3id.org/hsu-aut/css#> .\n"
                    "@prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .\n"
                    "<urn:arm> rdfs:label \"arm\" ; css:providesSkill <urn:arm:grasp> , <urn:arm:move> .\n"
                    "<urn:arm:grasp> rdfs:label \"grasp\" . <urn:arm:move> rdfs:label \"move\" .\n")
    bad.write_text("<urn:a>\n<urn:p> .\n")
    address, asked = "127.0.0.1:9154", "127.0.0.1:9155"
    commands = [
        [binaries / "ua-mes", mes, "--pki", folder / "mes-pki", "--interface", "lo", "--lds", "none", "--sparql", asked],
        [binaries / "ua-server", "--pki", pki, "--interface", "lo", "--metrics", address,
         "--endpoint", "opc.tcp://127.0.0.1:48403", "--status", f"http://{asked}"],
    ]
    log = (folder / "knowledge.log").open("w")
    running = [subprocess.Popen(command, stdout=log, stderr=log) for command in commands]
    find = lambda selector: judge.driver.find_elements(By.CSS_SELECTOR, selector)
    try:
        url = f"http://{address}/"
        judge.wait("the page is served", lambda: served(judge, url))
        judge.look("light", WIDE)
        judge.open(url, "knowledge")
        judge.wait("the questions are there", lambda: find("#question"))
        if find("#file"):
            judge.faults.append("a stranger has a form for files")
        sign(judge, "otto")
        if find("#file"):
            judge.faults.append("an operator has a form for files")
        judge.driver.find_element(By.ID, "sign").click()
        sign(judge, "erna")
        button = lambda name: next(one for one in find("main .button") if one.text == name)
        judge.wait("the engineer has a form for files", lambda: find("#file"))[0].send_keys(str(bad))
        button("Check").click()
        judge.wait("the fault has its line", lambda: "cannot be loaded" in judge.text() and find("td.number")[0].text == "2")
        judge.shoot("finding-light-wide")
        judge.accessible("finding")
        if button("Load").is_enabled():
            judge.faults.append("a file with faults can be loaded")
        find("#file")[0].send_keys(str(good))
        button("Check").send_keys(Keys.ENTER)
        judge.wait("the file can be loaded", lambda: button("Load").is_enabled())
        button("Load").send_keys(Keys.ENTER)
        judge.wait("the file is loaded", lambda: find(".badge") and find(".badge")[0].text == "loaded")
        choose = Select(find("#question")[0]).select_by_visible_text
        for scheme in ["light", "dark"]:
            for size in [WIDE, PHONE]:
                judge.look(scheme, size)
                choose("Components, capabilities and skills as a graph")
                find("#sparql")[0].send_keys(Keys.CONTROL, Keys.ENTER)
                judge.wait("the graph is drawn", lambda: len(find(".graph-node")) >= 3)
                name = f"knowledge-graph-{scheme}-{'phone' if size == PHONE else 'wide'}"
                judge.shoot(name)
                judge.overflow(name)
                judge.accessible(name)
                judge.driver.execute_script("document.querySelector('.graph').scrollIntoView({block: 'center'})")
                judge.shoot(name.replace("graph", "drawing"))
        judge.look("light", WIDE)
        choose("state-of")
        judge.wait("the parameter has a field", lambda: find(".parameters input"))[0].send_keys("grasp", Keys.ENTER)
        judge.wait("the question is answered", lambda: "skill_name" in [one.text for one in find(".result th")])
        judge.shoot("knowledge-question-light-wide")
        judge.accessible("question")
        pictures(judge, find, button)
        judge.console()
        judge.driver.get("about:blank")
    finally:
        for process in running:
            process.send_signal(signal.SIGTERM)
        for process in running:
            process.wait(20)
        log.close()


def pictures(judge, find, button):
    """Loads a manifest with a picture, and shows it by the keyboard, in both colours and widths."""
    judge.wait("no module has a picture", lambda: "No manifest in the graph has a picture" in judge.text())
    find("#file")[0].send_keys(str(MANIFEST))
    button("Check").send_keys(Keys.ENTER)
    judge.wait("the manifest can be loaded", lambda: button("Load").is_enabled())
    button("Load").send_keys(Keys.ENTER)
    choice = judge.wait("the picture is listed by its name", lambda: find("#picture"))[0]
    listed = [(group.get_attribute("label"), group.text.strip()) for group in find("#picture optgroup")]
    if listed != [("Column", "Overview")]:
        judge.faults.append(f"the pictures are {listed}")
    choice.send_keys(Keys.TAB)
    button("Show").send_keys(Keys.ENTER)
    names = lambda: [one.text for one in find(".module-picture g text")]
    judge.wait("the picture is drawn", names)
    if "Heater" not in names() or not find(".module-picture polyline.pipe"):
        judge.faults.append(f"the picture has the objects {names()}")
    about = find(".module-picture")[0].get_attribute("aria-label")
    if not about.startswith(f"Picture Overview: {len(names())} objects, "):
        judge.faults.append(f"the picture is named {about}")
    find("details summary")[0].send_keys(Keys.ENTER)
    judge.wait("the objects are in a table", lambda: "Heater" in judge.text("details table"))
    fills = []
    for scheme in ["light", "dark"]:
        for size in [WIDE, PHONE]:
            judge.look(scheme, size)
            name = f"knowledge-picture-{scheme}-{'phone' if size == PHONE else 'wide'}"
            judge.driver.execute_script("document.querySelector('.module-picture').scrollIntoView({block: 'center'})")
            judge.shoot(name)
            judge.overflow(name)
            judge.accessible(name)
        fills.append(find(".module-picture text")[0].value_of_css_property("fill"))
    if fills[0] == fills[1]:
        judge.faults.append(f"the picture has the text colour {fills[0]} in both colours")
    judge.look("light", WIDE)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binaries", type=pathlib.Path, required=True)
    parser.add_argument("--examples", type=pathlib.Path, required=True)
    parser.add_argument("--axe", type=pathlib.Path, required=True)
    parser.add_argument("--validator", type=pathlib.Path, required=True, help="html-validate")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    judge = Judge(arguments.out, arguments.axe)
    with tempfile.TemporaryDirectory() as folder:
        operate(judge, arguments.binaries, pathlib.Path(folder), arguments.examples)
        alarms(judge, arguments.binaries, pathlib.Path(folder))
        knowledge(judge, arguments.binaries, pathlib.Path(folder))
    for scenario, more in [("line-by-topics", ["--covers", "40", "--conveyor-off-at", "600"]), ("assembly-line", ["--covers", "24"])]:
        command = [arguments.binaries / "demo", "--scenario", scenario, *more]
        demo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        recorder = None
        try:
            url, folder = page_of(demo)
            judge.out = arguments.out / scenario
            judge.out.mkdir(exist_ok=True)
            judge.wait("the page is served", lambda: served(judge, url))
            recording = arguments.out / f"{scenario}.pcapng"
            recording.unlink(missing_ok=True)
            recorder = subprocess.Popen([arguments.binaries / "ua-space", "record", recording, "--interface", "lo"],
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            views(judge, url, values(judge, url))
            if scenario == "line-by-topics":
                events(judge, url)
                switch_off(judge, arguments.binaries, url, folder)
                judge.open(url, "events")
                judge.wait("the call is an event", lambda: "answered" in judge.text())
                judge.shoot("events-switched-off-light-wide")
            judge.console()
            judge.driver.get("about:blank")
        finally:
            ended = demo.poll()
            if ended is None:
                demo.send_signal(signal.SIGINT)
            if recorder:
                recorder.send_signal(signal.SIGINT)
            told, _ = demo.communicate(timeout=60)
            if ended is not None:
                print(f"the demo ended with {ended} before the judge did:\n{told[-3000:]}")
            if recorder:
                recorder.wait(20)
        if scenario == "line-by-topics":
            recorded(judge, arguments.binaries, recording)
    judge.driver.quit()
    documents = judge.valid(arguments.validator, arguments.out)
    print(json.dumps({"screenshots": str(arguments.out), "documents": documents, "faults": judge.faults}, indent=2))
    sys.exit(bool(judge.faults))


def served(judge, url):
    try:
        judge.driver.get(url)
        return True
    except Exception:
        return False


if __name__ == "__main__":
    main()
