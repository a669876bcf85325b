"""The web server under the service's page, the viewer and Foxglove's socket."""

from aquaflow.web.server import Answer, Request, Watcher, WebServer

__all__ = ["Answer", "Request", "Watcher", "WebServer"]
