"""MAVLink on the wire: framing, mapping, streams, signatures."""
