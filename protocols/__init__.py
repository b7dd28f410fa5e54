"""Device protocols: how a brain's messages become frames on a bus, and frames become events.

    messages            commands, requests, tasks and events: frozen values in SI
    frames              CanFrame, Packet, BusState: what is on a bus
    plugin              the plugin interface, and `load` to find an installed protocol by name
    toolkit             machinery that protocols share: message table, driver, firmware
    bounds              what a setting may be; who reads the files keeps it
    message_codec       messages as bytes
    reference_vectors   bytes from independent sources
    conformance         the contract that every plugin must pass
    transcripts         what hosts and devices exchange, as text, run as tests

Each other folder is one protocol. Nothing here imports `gateway` or `brain`, nor any I/O module; one
protocol never imports another. Import from the modules: this package itself exports nothing.
"""
