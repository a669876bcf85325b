"""The web server under the service's page and the viewer, and who may ask it."""
