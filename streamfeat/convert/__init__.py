"""Conversion: data set folders and camera files to MCAP recordings with labels.

Lives here: finding samples and their labels in folders, and writing them as one recording.
Not here: the formats of single files (`camera_files`), and anything that a running stream needs.
"""
