"""Simulated devices: they speak the true protocols on real ptys, sockets and CAN buses.

Encoders are written from the protocols' documents and share nothing with the decoders in
``drivers``, so that one tests the other.
"""
