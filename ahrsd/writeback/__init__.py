"""The write-back: from an accepted estimate to registers 23 and 84, proven, saved, confirmed.

Reading order: `states` (states and signals), `permissions` (what may be sent), `composition` (what
is written), `policy` (when), `transaction` (how), `journal_history` and `reconcile` (recovery after
an interruption), `machine` (all together). Pure: time and the journal's answers are arguments.
"""
