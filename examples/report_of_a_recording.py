"""Write the report of a recording, to be opened in a browser: report_of_a_recording.py FILE.mcap."""

import sys
from pathlib import Path

import gateway as gw

recording = Path(sys.argv[1])
page = recording.with_suffix(".html")
print(gw.write_report(recording, page).text())
print(f"{page}: {page.stat().st_size // 1000} kB")
# in a notebook: IPython.display.IFrame(page, width="100%", height=900)
