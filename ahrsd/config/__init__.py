"""The configuration: its tables and keys (`sections`), all that is done with it (`config`)."""
