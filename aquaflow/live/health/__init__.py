"""Health of the service: state, heartbeats, machine pressure, HTTP server."""
