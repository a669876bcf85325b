"""What a finished dive becomes: report, exports, measurements, sites, changes, viewer, videos."""
