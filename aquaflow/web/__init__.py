"""The web server under the service's page, the viewer and Foxglove's socket."""

from aquaflow.web.server import HttpRequest, HttpResponse, Watcher, WebServer

__all__ = ["HttpRequest", "HttpResponse", "Watcher", "WebServer"]
