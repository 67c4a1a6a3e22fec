"""``torchrun -m training.engine RECIPE DATA RUN``: train, one process a rank."""

from training.engine.launch import main

if __name__ == "__main__":
    main()
