CFLAGS = -O3
SOURCES = main.c policy.c $(wildcard policy_*.c)

policy: $(SOURCES) $(wildcard policy*.h)
	$(CC) -std=c99 $(CFLAGS) -o $@ $(SOURCES)

run: policy
	./policy

.PHONY: run
