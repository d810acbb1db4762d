"""What real drivers send to a VN-100 at their start, line by line, between $ and *.

dawonn/vectornav (ROS 2), ntnu-arl/vectornav and VectorNav's SDK 0.99 as they were traced; ArduPilot
only as it is described: text off, binary output without a time at 50 Hz.
"""

from __future__ import annotations

ROS2_DAWONN = (
    "VNRRG,01", "VNRRG,01", "VNRRG,01", "VNRRG,04", "VNRRG,02", "VNRRG,03", "VNRRG,00",
    "VNWRG,06,0", "VNWRG,07,20", "VNWRG,32,3,0,0,0,0,0,0,100000000,0", "VNWRG,30,0,0,0,0,1,0,1",
    "VNWRG,75,3,40,1,7FFF", "VNWRG,76,0,0,0", "VNWRG,77,0,0,0", "VNRRG,01",
)  # fmt: skip
NTNU_UP_TO_THE_RESET = ("VNWRG,05,115200", "VNRRG,01", "VNWNV", "VNRST")
NTNU_BEHIND_THE_RESET = (
    "VNRRG,01", "VNRRG,03", "VNRRG,04", "VNRRG,02", "VNWRG,06,0",
    "VNWRG,85,0,4,4,4,4,0,3,3,3,0", "VNWRG,75,1,4,6,1,3E", "VNWRG,76,0,1,0", "VNWRG,77,0,1,0",
)  # fmt: skip
SDK = ("VNRRG,01", "VNWRG,06,0,1", "VNWRG,75,1,20,01,0721")
ARDUPILOT = ("VNWRG,06,0", "VNWRG,75,3,16,01,0720", "VNRRG,01")
