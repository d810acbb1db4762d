"""An archive of recordings, calibrated and diagnosed one by one; each is one row, exactly once.

::

    archive    which recordings there are, on a disk or behind fsspec; one of them as a local file
    work       one recording -> one row, through the same functions as the commands
    row        what a row holds, and how a recording's answers become one
    guard      a process of its own round each recording: time, memory, crashes
    store      rows: spool/KEY.json, then parts/serial=N/HASH.parquet
    driver     a bounded window of recordings in flight, resumed where it was killed
    cluster    the same on a Dask cluster
    drift      all calibrations as columns, averaged to points by device and time
    trend      drift and change points of one device's calibrations
    questions  what the rows say: drift, recurring, failures, SQL
    told       answers as lines for a person
    page       and as one page

The row is written by the process that made it, before anybody is told. So whoever is killed, what
is in the folder is whole, and the same command goes on with what is missing.
"""
