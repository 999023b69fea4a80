"""The tables of the documents, each by one command."""
