"""Messages on topics, as data: topics, definitions, bytes.

Takes: Samples, events, statuses; or serialised messages.
Gives: Serialised messages; or columns and ``Measurement``.
Must not know: ROS: a message here is bytes with a definition.
Begin with: ``topics.py``.
"""
