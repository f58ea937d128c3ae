"""Data that lies elsewhere, seen as folders of this machine: buckets, archives, all file systems of fsspec.

A URL such as ``s3://bucket/kitti`` becomes a folder in the cache (`mirror`): everything there is listed, and each file
stands in the folder with its size but without its content. The content is fetched when a file is first opened, by
whatever reader: Python tells of every opening before it happens (`places`). So no reader knows where its data lies.
What is written into such a folder by `lcf3d.files` is sent there file by file.
"""
