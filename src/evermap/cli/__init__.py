"""The command line: one file a verb, heavy libraries imported only by the verb that runs."""
