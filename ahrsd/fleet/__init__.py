"""An archive of recordings, calibrated and diagnosed one by one; each is one row, exactly once.

::

    archive    which recordings there are, on a disk or behind fsspec; one of them as a local file
    row        what a row holds, and how a recording's answers become one
    store      rows: spool/KEY.json, then parts/serial=N/HASH.parquet
    run        over what has no row yet, resumed where it was killed; one recording -> one row,
               through the same functions as the commands
    drift      all calibrations as columns, averaged to points by device and time
    questions  what the rows say: drift, recurring, failures, SQL; the answers as lines for a person
    page       and as one page

Also of Monte Carlo and the blind trials::

    processes  a function over many tasks, here or on a Dask cluster, a bounded window of them in
               flight; a process of its own round each: time, memory, crashes

The row is written by the process that made it, before anybody is told. So whoever is killed, what
is in the folder is whole, and the same command goes on with what is missing.
"""
