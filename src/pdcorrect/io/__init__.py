"""Files: trajectories in HDF5 (`trajectory`) and for ParaView (`vtk`).

Nothing is imported here, so that stepping never loads h5py or meshio.
"""
