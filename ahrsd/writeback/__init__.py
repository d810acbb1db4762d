"""The write-back: from an accepted estimate to registers 23 and 84, proven, saved, confirmed.

Reading order: `states` (what can happen), `permissions` (what may be sent), `composition` (what is
written), `policy` (when), `transaction` (how), `journal_history` and `reconcile` (what was going on
before), `machine` (all of it together). Pure: time and the journal's answers are arguments.
"""
