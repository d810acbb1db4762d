"""Recordings: what `run` and `capture` write and what every command reads.

capture      *.mcap, everything in the order in which the core saw it
bytestream   *.vnraw *.vnbin *.bin *.log *.txt (also .gz), bytes and no host time
table        *.csv *.csv.gz *.parquet, samples
opening      one way to open any of the three
"""
