"""Messages of a stream: their CDR bytes, their payloads, their numbers and their times.

Lives here: codecs, packets, and the rules for sequence numbers and clocks, which recordings and live topics
share.
Not here: where messages come from or go to.
"""
