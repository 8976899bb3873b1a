"""Measures a value for vacuum-sensor.yaml: prints one JSON object a line.

{"values": {...}} has measured values by their names in the YAML, and {"fault": "..."} the reason
why they are unknown.
"""

import json
import os
import time

while True:
    try:
        message = {"values": {"Load": os.getloadavg()[0]}}
    except OSError as error:
        message = {"fault": str(error)}
    print(json.dumps(message), flush=True)
    time.sleep(0.5)
