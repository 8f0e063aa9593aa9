"""Events that others have written: camera files and data set folders, on their way to MCAP.

Lives here: folders and labels (`datasets`), one file of any known kind (`event_files`), and the formats:
sensor words (`words`), packets (`aedat4`), containers that a library opens (`containers`), text and NumPy
(`tables`).
Not here: recordings (`streamfeat.recordings.reader`), and anything that a running stream needs.
"""
