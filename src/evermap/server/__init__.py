"""A server for the maps of a fleet (`docs/server.md`): sessions are uploaded, queued, and entered by workers."""
