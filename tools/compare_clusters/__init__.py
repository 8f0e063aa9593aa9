"""Ray and Dask on the two jobs that streamfeat has for a cluster, and what each brings with it.

Lives here: what is run on workers (`work`), both engines behind one face (`engines`), the measurements of
sums over parts (`offline`) and of cameras served (`live`), two nodes in network namespaces (`nodes`).
"""
