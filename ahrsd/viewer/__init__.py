"""The rerun viewer: a process of its own, fed by a bounded queue."""
