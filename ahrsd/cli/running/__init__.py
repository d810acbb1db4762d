"""Commands that talk with the running daemon: status, explain, watch, page, operator, bundle."""
