"""Messages, zenoh and the log: everything that knows a key expression or a byte layout."""
