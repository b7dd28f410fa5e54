"""What a browser draws: the files of its pages in `page/`, beside the plotting library uPlot with its licence.

Must not import: `gateway.cli`. Nothing here moves a robot.
"""
