"""Camera files: events that other tools have written, one file of any known format at a time.

Lives here: recognising a format (`event_files`), and the formats: sensor words (`prophesee`, `vectors`),
packets (`aedat`, `aedat4`), containers that a library opens (`containers`), and tables (`text`, `arrays`,
with the meaning of their `columns`).
Not here: MCAP and bags (`recordings`), folders of labelled samples (`convert`).
"""
