"""What every program needs: run folders, checkpoints, devices, files, progress, interrupts, compilation."""
